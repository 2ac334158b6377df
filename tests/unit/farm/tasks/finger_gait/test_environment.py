"""The Gymnasium environment: found by its id, passes Gymnasium's checks, and gives the farm's
numbers.
"""

import os
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from farm.errors import ConfigError
from farm.policies.fourier import Kernel, KernelConfig
from farm.policies.recurrent import Rnn, RnnConfig
from farm.runner import Runner
from farm.tasks.finger_gait.env import FingerGaitEnv
from farm.tasks.finger_gait.hand import LOWER, UPPER
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.rewards import RETURN_SCALE, WEIGHTS
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.loop import Acting
from farm.tasks.rollouts import discounted

pytestmark = pytest.mark.usefixtures("grips_found_once")

ID = "farm.tasks.finger_gait.env:rolloutfarm/FingerGait-v0"


def episode(env, policy, theta, seed):
    """Drive an environment by a farm's policy: rewards, terms, whether the last step was terminal
    and successful.
    """
    x, _ = env.reset(seed=seed)
    acting = Acting(policy, theta[None])
    rewards, terms, over = [], [], False
    while not over:
        x, reward, terminated, truncated, info = env.step(acting.act(x[None])[0])
        rewards.append(reward)
        terms.append(list(info["reward_terms"].values()))
        over = terminated or truncated
    return np.array(rewards), np.array(terms), terminated, info["is_success"]


@pytest.mark.parametrize(
    ("state", "action", "motion"),
    [
        ("joints", "offset", 0.0),
        ("joints+tactile", "absolute", 2.0),
        ("joints+contacts", "increment", 0.0),
    ],
)
@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize(
    ("kind", "config"), [(Kernel, KernelConfig(bandwidth=3.0)), (Rnn, RnnConfig(units=4))]
)
def test_an_episode_is_the_farms_rollout_bit_for_bit(state, action, motion, seed, kind, config):
    task = FingerGait(
        FingerGaitConfig(state=state, perturb=seed is not None, action=action, motion=motion)
    )
    policy = kind(config, task.spec(), {})
    farm_seed = None
    if seed is not None:
        farm_seed = tuple(np.random.default_rng(seed).integers(0, 2**32, 4).tolist())
    thetas = np.random.default_rng(1).normal(1.0 if kind is Kernel else 0.0, 0.8, (4, policy.size))
    rollouts = Runner(task, policy).rollouts(thetas, [farm_seed] * len(thetas))
    env = FingerGaitEnv(action=action, state=state, perturb=task.config.perturb, motion=motion)
    for i, theta in enumerate(thetas):
        rewards, terms, terminated, success = episode(env, policy, theta, seed)
        steps = len(rewards)
        assert (steps, terminated, success) == (
            rollouts.steps[i],
            rollouts.ended[i],
            rollouts.success[i],
        )
        assert terms.tobytes() == np.ascontiguousarray(rollouts.terms[i, :steps]).tobytes()
        returns, _ = discounted(terms[None], task.config.gamma, RETURN_SCALE)
        assert returns[0] == rollouts.returns[i]
        assert rewards @ task.config.gamma ** np.arange(steps) == pytest.approx(
            rollouts.returns[i], rel=1e-12
        )


def test_success_is_the_farms():
    """A grip commanded at once succeeds; one that is held does not."""
    steps, env = 15, FingerGaitEnv(action="absolute")
    goal = FingerGaitEnv(start_grip="index+middle+thumb")._task.start_commands[0]
    start = env._task.start_commands[0]
    for command, expected in ((goal, True), (start, False)):
        env.reset()
        transitions = [env.step(command) for _ in range(steps)]
        assert [bool(truncated) for _, _, _, truncated, _ in transitions] == [False] * (
            steps - 1
        ) + [True]
        assert [info["is_success"] for *_, info in transitions] == [False] * (steps - 1) + [
            expected
        ]


def test_dropping_ends_an_episode_with_the_penalty():
    env = FingerGaitEnv(action="absolute")
    env.reset()
    for _ in range(15):
        _, reward, terminated, truncated, info = env.step(LOWER)
        if terminated:
            break
    assert terminated
    assert not truncated
    assert not info["is_success"]
    assert info["reward_terms"]["drop"] == -WEIGHTS["projected"].drop
    assert reward == RETURN_SCALE * sum(info["reward_terms"].values())


def test_physics_that_fails_ends_an_episode_and_the_next_is_as_ever():
    env = FingerGaitEnv()
    first, _ = env.reset()
    env._sim.engine.data.qvel[3] = np.inf
    x, reward, terminated, truncated, info = env.step(np.zeros(8))
    assert (terminated, truncated) == (True, False)
    assert np.isfinite(x).all()
    assert reward == RETURN_SCALE * -WEIGHTS["projected"].drop
    assert env.reset()[0].tobytes() == first.tobytes()


def test_seeds_perturb_and_repeat():
    env = FingerGaitEnv(perturb=True, state="joints+tactile")
    one, two, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    assert one.tobytes() == two.tobytes()
    assert one.tobytes() != other.tobytes()
    assert env.reset()[0].tobytes() != other.tobytes()
    nominal = FingerGaitEnv(state="joints+tactile")
    assert nominal.reset(seed=1)[0].tobytes() == nominal.reset(seed=2)[0].tobytes()


@pytest.mark.parametrize(
    ("state", "perturb"), [*((state, True) for state in STATES), ("joints", False)]
)
def test_gymnasium_finds_it_and_has_nothing_to_say(state, perturb):
    env = gymnasium.make(ID, state=state, perturb=perturb)
    with warnings.catch_warnings(record=True) as records:
        warnings.simplefilter("always")
        check_env(env.unwrapped, skip_render_check=True)
    assert [str(warning.message) for warning in records] == []
    assert env.observation_space.shape == (STATES[state].size,)


def test_joint_positions_as_actions_have_the_joints_limits():
    space = FingerGaitEnv(action="absolute").action_space
    assert (space.low == LOWER).all()
    assert (space.high == UPPER).all()


@pytest.mark.parametrize("setting", [{"state": "sight"}, {"action": "torque"}, {"object": "cat"}])
def test_a_setting_that_makes_no_sense_is_named(setting):
    with pytest.raises(ConfigError, match=f"unknown .*{next(iter(setting.values()))}"):
        gymnasium.make(ID, **setting)


_CHECK = f"""
import gymnasium, numpy, warnings
from gymnasium.utils.env_checker import check_env
warnings.simplefilter("error")
env = gymnasium.make("{ID}", render_mode="rgb_array", perturb=True)
check_env(env.unwrapped)
env.reset(seed=0)
before = env.render()
assert before.shape == (480, 640, 3) and before.dtype == numpy.uint8
for _ in range(5):
    env.step(numpy.ones(8))
assert (env.render() != before).any()
env.close()
"""


def _run(code: str) -> "subprocess.CompletedProcess[str]":
    environment = {**os.environ, "MUJOCO_GL": "egl"}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_program_that_imports_gymnasium_alone_makes_checks_and_renders_it():
    if _run("from mujoco.egl import GLContext; GLContext(8, 8)").returncode:
        pytest.skip("no EGL: nothing renders without a screen here")
    process = _run(_CHECK)
    assert (process.returncode, process.stderr) == (0, "")
