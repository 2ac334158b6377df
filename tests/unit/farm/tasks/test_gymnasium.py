"""Gymnasium's environments as tasks: equal to a plain loop, bit for bit; accepted names; clear
errors.
"""

import subprocess
import sys
from functools import cache

import gymnasium
import numpy as np
import pytest

from farm import plugins, seeds
from farm.errors import ConfigError
from farm.net.work import Jobs
from farm.policies.fourier import Direct, FeaturesConfig
from farm.returns import RETURN_FLOOR
from farm.runner import Runner
from farm.tasks.actions.synergies import Synergies
from farm.tasks.gymnasium import Environment, EnvironmentConfig, reset_seed
from farm.tasks.gymnasium_engine import NOMINAL, make

SEED = seeds.training(0, 3, 4)


@cache
def new_runner(name: str, **settings) -> Runner:
    task = Environment(EnvironmentConfig(**settings), name)
    spec, config = task.spec(), FeaturesConfig(features=20)
    return Runner(task, Direct(config, spec, Direct.draw(config, spec, np.random.default_rng(0))))


def theta_of(runner: Runner, count: int = 1, scale: float = 0.5) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, scale, (count, runner.policy.size))


@pytest.mark.parametrize("name", ["Pusher-v5", "Hopper-v5", "InvertedPendulum-v5", "Ant-v5"])
@pytest.mark.parametrize("seed", [None, SEED])
def test_a_rollout_is_a_plain_loops(name, seed):
    runner, gamma = new_runner(name, gamma=0.95), 0.95
    theta = theta_of(runner)
    rollouts = runner.rollouts(theta, [seed])
    env = gymnasium.make(name)
    x, _ = env.reset(seed=reset_seed(None if seed is None else np.random.default_rng(seed)))
    prepared, rewards, over = runner.policy.prepare(theta), [], False
    while not over:
        raw = np.clip(runner.policy.act(prepared, x[None])[0], -1.0, 1.0)
        action = (
            env.action_space.low
            + (env.action_space.high - env.action_space.low) * (raw + 1.0) / 2.0
        )
        x, reward, terminated, truncated, _ = env.step(action.astype(np.float32))
        rewards.append(reward)
        over = terminated or truncated
    assert rollouts.terms[0, : len(rewards), 0].tolist() == pytest.approx(rewards, rel=0, abs=1e-12)
    assert rollouts.frames["qpos"][0, len(rewards) - 1].tolist() == env.unwrapped.data.qpos.tolist()
    assert rollouts.returns[0] == pytest.approx(
        sum(gamma**t * reward for t, reward in enumerate(rewards)), abs=1e-9
    )
    assert (rollouts.steps[0], rollouts.ended[0], rollouts.failed[0]) == (
        len(rewards),
        terminated,
        False,
    )


@pytest.mark.parametrize("name", ["Hopper-v5", "Ant-v4"])
def test_rollouts_do_not_depend_on_their_batch(name):
    runner = new_runner(name)
    seeded = [SEED, None, SEED, (3, 1, 2, 0), None]
    theta = theta_of(runner, 5)
    together = runner.rollouts(theta, seeded)
    assert len(set(together.steps.tolist())) > 1, "some fall sooner"
    for row in range(5):
        alone = runner.rollouts(theta[row : row + 1], [seeded[row]])
        assert alone.returns[0] == together.returns[row]
        assert alone.frames["qpos"].tobytes() == together.frames["qpos"][row].tobytes()


@pytest.mark.parametrize("name", ["Reacher-v5", "Ant-v4"])
def test_a_pair_starts_alike_and_seeds_differ(name):
    runner = new_runner(name)
    theta = np.repeat(theta_of(runner), 3, axis=0)
    start = runner.rollouts(theta, [SEED, SEED, seeds.training(0, 3, 5)]).start["qpos"]
    assert start[0].tolist() == start[1].tolist() != start[2].tolist()
    assert reset_seed(None) == NOMINAL
    reset_seeds = {reset_seed(np.random.default_rng(seeds.training(0, 0, i))) for i in range(100)}
    assert len(reset_seeds) == 100


@pytest.mark.parametrize(("name", "parts"), [("Ant-v4", 1), ("Pusher-v5", 5)])
def test_a_trajectory_shows_the_scene_at_physics_rate_where_it_can(name, parts):
    runner = new_runner(name, steps=5)
    outcome = runner.run(theta_of(runner)[0], Jobs.single(theta_of(runner)[0], "physics", SEED))
    [trajectory] = outcome.trajectories
    assert trajectory.fits(runner.spec.shapes(len(runner.scene.bodies)))
    np.testing.assert_allclose(trajectory.times, np.arange(5 * parts + 1) * 0.05 / parts)
    rollouts = runner.rollouts(theta_of(runner), [SEED])
    np.testing.assert_allclose(
        trajectory.bodies[parts::parts], runner.scene.poses(rollouts.frames["qpos"][0]), atol=1e-6
    )
    assert (trajectory.value, trajectory.success) == (rollouts.returns[0], None)
    assert outcome.traces.size == 0


def test_physics_that_blows_up_is_never_good():
    runner = new_runner("Ant-v4", steps=50)
    theta, env = theta_of(runner, scale=5.0), runner.sim.engine._envs[0].unwrapped
    before = runner.rollouts(theta, [None]).returns[0]
    env.model.opt.timestep = 0.5
    failed = runner.rollouts(theta, [None])
    assert (failed.failed[0], failed.clamped[0], failed.returns[0]) == (True, True, RETURN_FLOOR)
    env.model.opt.timestep = 0.01
    assert runner.rollouts(theta, [None]).returns[0] == before


def test_the_spec_is_the_environments():
    spec = new_runner("Pusher-v5").spec
    assert (spec.observation, spec.action, spec.steps, spec.period, spec.terms) == (
        23,
        7,
        100,
        0.05,
        ("reward",),
    )
    assert (spec.success, spec.channels, spec.release) == (
        False,
        (),
        f"gymnasium {gymnasium.__version__}",
    )
    assert new_runner("Swimmer-v5", steps=7).spec.steps == 7
    with pytest.raises(ConfigError, match="--steps 1001: task gym:Swimmer-v5 ends after 1000"):
        new_runner("Swimmer-v5", steps=1001)


def test_a_subclass_may_be_shorter_and_has_the_environments_own_actions():
    short = type("Short", (Environment,), {"steps": 30})
    assert short(variant="Swimmer-v5").steps == 30
    assert type("Shorter", (short,), {})(variant="Swimmer-v5").steps == 30
    assert short(Environment.Config(steps=20), "Swimmer-v5").steps == 20
    for steps, words in ((-3, "steps is -3; expected"), (5000, "steps is 5000: task gym:Sw")):
        with pytest.raises(ConfigError, match=f"task Long: {words}"):
            type("Long", (Environment,), {"steps": steps})(variant="Swimmer-v5")
    other = type("Other", (Environment,), {"actions": Synergies([[1.0, 1.0]])})
    with pytest.raises(
        ConfigError, match="task Other: actions is a Synergies, but those of an env"
    ):
        other(variant="Swimmer-v5")


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Swimmr-v5", "Did you mean: `Swimmer`"),
        ("Swimmer-v99", "`v5`"),
        ("CartPole-v1", "not an environment of MuJoCo, and only those can be learnt; take one"),
        (
            "BipedalWalker-v3",
            "not an environment of MuJoCo, and only those can be learnt; take one",
        ),
        (
            "LunarLander-v3",
            r"or write its model as a task \(farm new-task\), which farm run learns, and farm.Farm",
        ),
        ("phys2d/CartPole-v1", "not an environment of MuJoCo"),
        (
            "ALE/Pong-v5",
            (
                r"installed the proper package for ALE\? \(before you do: only environments that"
                r" MuJoCo"
            ),
        ),
        ("Pusher-v2", "moved"),
    ],
)
def test_what_cannot_be_learnt_is_one_line(name, line):
    with pytest.raises(ConfigError, match=line) as error:
        make(name)
    assert str(error.value).startswith(f"task gym:{name}: ")
    assert "\n" not in str(error.value)


def test_an_environment_that_fails_without_a_word_is_said_to_fail_where(monkeypatch):
    def refuses(*_, **__):
        raise AssertionError

    monkeypatch.setattr(gymnasium, "make", refuses)
    with pytest.raises(
        ConfigError,
        match=r"^task gym:Hand-v1: AssertionError in test_gymnasium.py, line \d+: raise",
    ):
        make("Hand-v1")


@pytest.mark.parametrize(
    "name",
    ["os:Swimmer-v5", "antigravity:Reacher-v5", "Swimmer", "Swimmer-v", "a/b/c-v1", "x-v1\n"],
)
def test_names_that_are_none_are_refused_and_nothing_is_imported(name):
    with pytest.raises(ConfigError, match="gym:NAME-vN"):
        Environment(EnvironmentConfig(), name)
    assert "antigravity" not in sys.modules


def test_it_is_chosen_by_name():
    plugin = plugins.find("tasks", "gym:Swimmer-v5")
    assert (plugin.target, plugin.variant, plugin.wire) == (
        Environment,
        "Swimmer-v5",
        "gym:Swimmer-v5",
    )
    with pytest.raises(ConfigError, match="expected gym:NAME"):
        plugins.find("tasks", "gym")


def test_without_gymnasium_it_says_what_to_install():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from farm.__main__ import main\n"
        "sys.exit(main(['run', '--task', 'gym:Swimmer-v5', '--no-record']))"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    line = "farm: task gym:Swimmer-v5 needs gymnasium: pip install 'gymnasium[mujoco]'\n"
    assert (process.returncode, process.stderr) == (2, line)


@pytest.mark.parametrize("name", ["Humanoid-v5", "Pusher-v5"])
def test_a_scene_has_names_of_its_own_for_everything(name):
    scene = new_runner(name).scene
    geometries = scene.geometries()
    assert len({geometry.name for geometry in geometries}) == len(geometries) == scene.model.ngeom
    assert len(set(scene.bodies)) == len(scene.bodies)
    poses = scene.poses(scene.model.qpos0[None])
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0)


def test_arguments_of_an_environment():
    plain = new_runner("Hopper-v5")
    free = new_runner("Hopper-v5", env_arg=("terminate_when_unhealthy=false", "healthy_reward=7"))
    theta = theta_of(plain)
    short, long = plain.rollouts(theta, [None]), free.rollouts(theta, [None])
    assert short.steps[0] < long.steps[0] == 1000
    at = short.steps[0] - 1
    assert long.terms[0, :at, 0].tolist() == pytest.approx((short.terms[0, :at, 0] + 6.0).tolist())
    wide = new_runner("Hopper-v5", env_arg=("exclude_current_positions_from_observation=false",))
    assert wide.spec.observation == plain.spec.observation + 1
    assert EnvironmentConfig(env_arg=("healthy_z_range=[0.1, 9]",)).arguments == {
        "healthy_z_range": [0.1, 9]
    }


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("healthy_reward",), "env-arg is 'healthy_reward'; expected NAME=VALUE"),
        (("=3",), "env-arg is '=3'; expected NAME=VALUE"),
        ((3,), "env-arg is '3'; expected NAME=VALUE"),
        (("healthy_reward=lots",), "env-arg healthy_reward is 'lots'; expected a value of JSON"),
        (("a=1", "a=2"), "env-arg: a is given twice"),
        (
            ('xml_file="hopper.xml"',),
            "env-arg xml_file is not taken: a file does not travel to workers",
        ),
        (('render_mode="human"',), "env-arg render_mode is not taken"),
    ],
)
def test_arguments_that_make_no_sense(arguments, reason):
    with pytest.raises(ConfigError, match=reason):
        EnvironmentConfig(env_arg=arguments)


@pytest.mark.parametrize("argument", ["colour=1", "disable_env_checker=true", "healthy_z_range=3"])
def test_arguments_that_an_environment_does_not_take(argument):
    with pytest.raises(ConfigError, match="task gym:Hopper-v5: "):
        Environment(EnvironmentConfig(env_arg=(argument,)), "Hopper-v5").spec()
