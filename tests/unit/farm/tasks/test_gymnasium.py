"""Rollouts in Gymnasium's environments against a plain loop, bit for bit."""

import dataclasses
import sys
from functools import cache

import gymnasium
import numpy as np
import pytest

from farm import seeds as randomness
from farm import tasks
from farm.errors import ConfigError
from farm.net import codec
from farm.net.work import Job
from farm.net.messages import Spec
from farm.net.work import Result, Results
from farm.policies.fourier import Features, Policy, PolicyConfig
from farm.tasks.finger_gait.rewards import RETURN_FLOOR
from farm.tasks.finger_gait.task import TaskConfig
from farm.tasks.gymnasium import NOMINAL, Environment, reset_seed
from workers.backends.cpu import CpuBackend

CONTROLLER = PolicyConfig(controller="direct", features=20)
SEED = randomness.training(0, 3, 4)


def policy_of(config: TaskConfig) -> Policy:
    sizes = tasks.sizes(config)
    features = Features.draw(CONTROLLER, sizes.observation, np.random.default_rng(0))
    return Policy(CONTROLLER, sizes.observation, features, (sizes.lower, sizes.upper))


@cache
def episodes(task: str, **settings) -> Environment:
    config = TaskConfig(task=task, **settings)
    return Environment(config, policy_of(config))


def theta_of(task: str, scale: float = 0.5, number: int = 0):
    return np.random.default_rng(number).normal(0.0, scale, episodes(task).policy.size)


def job(index: int, eps, **changes) -> Job:
    values = {"index": index, "origin": "zero", "signs": (1, -1), "perturbation": SEED, "rate": "none", "eps": eps}
    return Job(**(values | changes))


@pytest.mark.parametrize("name", ["Pusher-v5", "Hopper-v5", "InvertedPendulum-v5", "Reacher-v5"])
@pytest.mark.parametrize("perturbation", [None, SEED])
def test_an_episode_is_a_plain_loops(name, perturbation):
    task, gamma = f"gym:{name}", TaskConfig().gamma
    theta = theta_of(task)
    episode = episodes(task).episode(theta, perturbation)
    policy, env = policy_of(TaskConfig(task=task)), gymnasium.make(name)
    x, _ = env.reset(seed=reset_seed(perturbation))
    weights, rewards, over = policy.weights(theta[None]), [], False
    while not over:
        raw = np.clip(policy.actions(weights, x[None])[0], -1.0, 1.0)
        action = env.action_space.low + (env.action_space.high - env.action_space.low) * (raw + 1.0) / 2.0
        x, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        rewards.append(reward)
        over = terminated or truncated
    assert episode.rewards.tolist() == rewards
    assert episode.qpos[-1].tolist() == env.unwrapped.data.qpos.tolist()
    assert episode.value == sum(gamma**t * reward for t, reward in enumerate(rewards))
    assert not episode.failed
    if name == "Hopper-v5":
        assert len(rewards) < 1000, "it fell, and that ended it"


def test_both_rollouts_of_a_pair_start_alike():
    runner = episodes("gym:Reacher-v5")
    theta = theta_of("gym:Reacher-v5")
    first, second = runner.episode(theta, SEED), runner.episode(-theta, SEED)
    assert first.qpos[0].tolist() == second.qpos[0].tolist()
    assert first.value != second.value
    other = runner.episode(theta, randomness.training(0, 3, 5))
    assert first.qpos[0].tolist() != other.qpos[0].tolist()
    nominal = [runner.episode(theta, None).value for _ in range(2)]
    assert nominal[0] == nominal[1]
    assert reset_seed(None) == NOMINAL
    assert len({reset_seed(randomness.training(0, 0, i)) for i in range(100)}) == 100


def sent(result: Result) -> bytes:
    return codec.encode(Results.of([result], run="r", incarnation="i", round=1, worker="w/1", traces="none"))


def test_jobs_do_not_know_of_each_other():
    runner, mu = episodes("gym:Hopper-v5"), theta_of("gym:Hopper-v5")
    jobs = [
        job(4, theta_of("gym:Hopper-v5", number=1), origin="mu"),
        job(2, np.empty(0), origin="mu", signs=(1,), perturbation=None, rate="control"),
        job(9, theta_of("gym:Hopper-v5", number=2), perturbation=(3, 1, 2, 0)),
    ]
    together = runner.run(mu, jobs)
    alone = [runner.run(mu, [one])[0] for one in reversed(jobs)][::-1]
    assert [result.index for result in together] == [4, 2, 9]
    for one, other in zip(together, alone, strict=True):
        assert sent(one) == sent(other)


@pytest.mark.parametrize("rate", ["control", "physics"])
def test_a_trajectory_shows_the_scene(rate):
    config = TaskConfig(task="gym:Pusher-v5", steps=5)
    runner, scene, sizes = Environment(config, policy_of(config)), tasks.scene(config), tasks.sizes(config)
    theta = theta_of("gym:Pusher-v5")
    [result] = runner.run(theta, [job(0, theta, signs=(1,), rate=rate)])
    episode = runner.episode(theta, SEED)
    shown = result.trajectory.trajectory()
    assert result.trajectory.fits(sizes.shapes(len(scene.bodies)))
    np.testing.assert_allclose(shown.times, np.arange(6) * 0.05)
    np.testing.assert_allclose(shown.bodies, scene.poses(episode.qpos), atol=1e-6)
    np.testing.assert_allclose(shown.targets[1:], episode.actions, atol=1e-6)
    np.testing.assert_allclose(shown.terms[1:, 0], episode.rewards, rtol=1e-6)
    assert (shown.value, shown.success) == (episode.value, None)
    assert result.traces.shape == (1, 0, 54)
    assert not result.success.any()


def test_physics_that_blows_up_is_never_good():
    config = TaskConfig(task="gym:HalfCheetah-v5", steps=50)
    runner = Environment(config, policy_of(config))
    runner._env.unwrapped.model.opt.timestep = 0.5
    theta = theta_of("gym:HalfCheetah-v5", 5.0)
    [result] = runner.run(theta, [job(0, theta, signs=(1,), rate="control")])
    assert result.failed.all()
    assert result.clamped.all()
    assert (result.returns == RETURN_FLOOR).all()
    assert len(result.trajectory.times) <= 50
    codec.encode(result.trajectory)
    runner._env.unwrapped.model.opt.timestep = 0.01
    assert runner.episode(theta, None).value == Environment(config, policy_of(config)).episode(theta, None).value


# ---------------------------------------------------------------- specifications


def make_spec(**changes) -> Spec:
    config = TaskConfig(task="gym:Reacher-v5")
    drawn = Features.draw(CONTROLLER, 10, np.random.default_rng(0))
    values = {
        "run": "r", "task": config.task, "task_config": dataclasses.asdict(config),
        "policy_config": dataclasses.asdict(CONTROLLER), "frequencies": drawn.frequencies, "phases": drawn.phases,
        "release": gymnasium.__version__,
    }  # fmt: skip
    return Spec(**(values | changes))


def test_a_backend_is_made_of_a_specification():
    backend = CpuBackend(codec.decode(codec.encode(make_spec()), Spec))
    theta = theta_of("gym:Reacher-v5")
    assert backend.parameters == theta.size == 2 * 20
    [result] = backend.run(theta, [job(0, theta)])
    assert result.returns[0] == episodes("gym:Reacher-v5").episode(theta, SEED).value


def test_another_release_is_refused():
    with pytest.raises(ConfigError, match=r"the run has gym:Reacher-v5 of gymnasium 0\.1, here is"):
        CpuBackend(make_spec(release="0.1"))


def test_a_module_that_a_name_asks_for_is_not_imported():
    assert "antigravity" not in sys.modules
    with pytest.raises(ConfigError, match="names a module to import, which is refused"):
        CpuBackend(make_spec(task="gym:antigravity:Reacher-v5"))
    assert "antigravity" not in sys.modules
