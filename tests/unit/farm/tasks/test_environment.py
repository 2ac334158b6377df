"""Any task as an environment of Gymnasium: its checks, the farm's numbers, and vectors of them."""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from carts import Pole, new_runner, thetas

import farm
from farm.errors import ConfigError, TaskError
from farm.seeds import evaluation_start
from farm.tasks.loop import Acting

gymnasium = pytest.importorskip("gymnasium")


class Late(Pole):
    """Reads outputs of the simulator for the first time in the middle, and at the end; nine
    terms.
    """

    def observe(self, sim):
        """Forces on the cart, late: read from the fifth step on."""
        x = super().observe(sim)
        return x if sim.t < 5 else x + 0.01 * sim.cacc[:, 1, :1]

    def reward(self, sim, action):
        """Terms of which the sum depends on the order."""
        return {f"{i}": np.cos(sim.qpos[:, 1] * 3.0**i) for i in range(9)}

    def success(self, sim):
        """Forces of contacts, of which there are none."""
        return (sim.contact_forces() == 0.0).all(axis=(1, 2))


class Broken(Pole):
    """Observation, reward and physics are not finite, each at other angles or actions."""

    def observe(self, sim):
        """Nothing to the left."""
        x = super().observe(sim)
        return np.where(sim.qpos[:, 1:2] < -0.45, np.nan, x)

    def reward(self, sim, action):
        """Nothing to the right."""
        return np.where(sim.qpos[:, 1] > 0.45, np.nan, 1.0)

    def ended(self, sim):
        """Never."""
        return np.zeros(len(sim), dtype=bool)

    def act(self, sim, action):
        """Fast if pushed."""
        sim.qvel[:, 1] = np.where(action[:, 0] > 5.0, 1e9, sim.qvel[:, 1])
        return super().act(sim, action)


def episode(env, policy, theta, seed):
    """Rewards, terms and what the last step said."""
    x, _ = env.reset(seed=seed)
    acting = Acting(policy, theta[None])
    rewards = []
    terms = []
    observations = [x]
    while True:
        x, reward, terminated, truncated, info = env.step(acting.act(x[None])[0])
        rewards.append(reward)
        terms.append(list(info["reward_terms"].values()))
        observations.append(x)
        if terminated or truncated:
            return np.array(rewards), np.array(terms), np.array(observations), terminated, info


@pytest.mark.parametrize("kind", [Pole, Late, Broken])
@pytest.mark.parametrize("perturb", [True, False])
def test_an_episode_is_the_farms_rollout_bit_for_bit(kind, perturb):
    runner = new_runner(kind, perturb=perturb)
    parameters = thetas(runner, 12, scale=2.0)
    seeds = [evaluation_start(0, 7 * i) if perturb else None for i in range(12)]
    rollouts = runner.rollouts(parameters, seeds)
    assert kind is Broken or len(set(rollouts.steps.tolist())) > 2, "some end early"
    env = farm.environment(kind, perturb=perturb)
    for i, theta in enumerate(parameters):
        rewards, terms, _, terminated, info = episode(env, runner.policy, theta, 7 * i)
        steps = int(rollouts.steps[i])
        if rollouts.failed[i] and len(rewards) == steps - 1:
            steps -= 1  # what cannot be seen ends an episode as it appears
        assert len(rewards) == steps
        assert terms.tobytes() == np.ascontiguousarray(rollouts.terms[i, :steps]).tobytes()
        assert rewards.tobytes() == rollouts.terms[i].sum(axis=-1)[:steps].tobytes()
        assert terminated == (rollouts.ended[i] or rollouts.failed[i])
        assert info["failed"] == rollouts.failed[i]
        assert info["is_success"] == rollouts.success[i]
    if kind is Broken:
        assert 0 < rollouts.failed.sum()


def test_the_last_observation_is_that_of_the_state_that_ended_it():
    class Seen(Pole):
        def observe(self, sim):
            return np.array(sim.qpos)

    env = farm.environment(Seen)
    runner = new_runner(Seen)
    policy = runner.policy
    parameters = thetas(runner, 20, scale=0.3)
    ended = 0
    for i, theta in enumerate(parameters):
        *_, observations, terminated, _ = episode(env, policy, theta, i)
        fallen = (abs(observations[:, 1]) > 0.6).tolist()
        assert fallen == [False] * (len(observations) - 1) + [terminated]
        ended += terminated
    assert 0 < ended < len(parameters)


def test_physics_that_blows_up_terminates_without_a_reward():
    env = farm.environment(Broken)
    before, _ = env.reset(seed=0)
    x, reward, terminated, truncated, info = env.step([10.0])
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert (info["failed"], info["is_success"]) == (True, False)
    assert x.tolist() == before.tolist(), "the last one that is finite"
    with pytest.raises(TaskError, match=r"no episode is on its way: call reset\(\)"):
        env.step([0.0])


def test_a_start_that_cannot_be_observed_is_an_error():
    class Never(Pole):
        def observe(self, sim):
            return super().observe(sim) * (np.nan if sim.own["goal"].any() else 1.0)

    with pytest.raises(TaskError, match="observe is not finite before control step 1"):
        farm.environment(Never).reset(seed=0)


@pytest.mark.parametrize("kind", [Pole, Late, Broken])
def test_a_vector_gives_the_numbers_of_each_alone(kind):
    """Also of those that end early and begin anew while others go on."""
    count = 5
    steps = 60
    vector = farm.environment(kind, num_envs=count)
    singles = [farm.environment(kind) for _ in range(count)]
    assert vector.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.NEXT_STEP
    starts, _ = vector.reset(seed=3)
    for i, env in enumerate(singles):
        assert env.reset(seed=3 + i)[0].tobytes() == starts[i].tobytes()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, count, 1))
    over = np.zeros(count, dtype=bool)
    restarts = 0
    for action in actions:
        given = np.where(over[:, None], np.nan, action)  # which is ignored
        x, reward, terminated, truncated, info = vector.step(given)
        for i, env in enumerate(singles):
            assert info["_failed"][i] == (not over[i])
            if over[i]:
                restarts += 1
                assert env.reset()[0].tobytes() == x[i].tobytes()
                assert (reward[i], terminated[i], truncated[i]) == (0.0, False, False)
                continue
            alone = env.step(action[i])
            assert alone[0].tobytes() == x[i].tobytes()
            assert alone[1:4] == (reward[i], terminated[i], truncated[i])
            assert alone[4]["failed"] == info["failed"][i]
            assert alone[4]["is_success"] == info["is_success"][i]
            terms = alone[4]["reward_terms"]
            assert terms == {name: info["reward_terms"][name][i] for name in terms}
        over = terminated | truncated
    assert restarts > 2 * count
    vector.close()


def test_a_vector_restarts_what_is_on_its_way():
    vector = farm.environment(Pole, num_envs=3)
    with pytest.raises(TaskError, match=r"call reset\(\)"):
        vector.step(np.zeros((3, 1)))
    first, _ = vector.reset(seed=[4, 5, 6])
    for _ in range(8):
        vector.step(np.ones((3, 1)))
    assert vector.reset(seed=4)[0].tobytes() == first.tobytes()
    assert vector.reset()[0].tobytes() != first.tobytes()
    with pytest.raises(ConfigError, match="2 seeds; expected 3, one for each environment"):
        vector.reset(seed=[1, 2])


@pytest.mark.parametrize("name", ["gym:Hopper-v5", "gym:Pusher-v5"])
def test_an_environment_of_gymnasium_as_a_task_is_one_again(name):
    env = farm.environment(name)
    env.reset(seed=0)
    *_, info = env.step(env.action_space.sample())
    assert "is_success" not in info
    vector = farm.environment(name, num_envs=20)
    assert vector.reset(seed=0)[0].shape == (20, *env.observation_space.shape)


@pytest.mark.parametrize("kind", [Pole, Late])
def test_gymnasiums_checks_pass(kind):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(farm.environment(kind), skip_render_check=True)
    texts = [str(each.message) for each in caught]
    assert all("Box observation space" in text for text in texts), "its bounds are unknown"


def test_actions_have_the_bounds_that_the_task_declares():
    class Pushed(Pole):
        actions = (farm.Quantity("slow", low=-0.5, high=0.25), farm.Quantity("unknown"))

        def act(self, sim, action):
            return super().act(sim, action[:, :1])

    space = farm.environment(Pushed).action_space
    assert (space.low.tolist(), space.high.tolist()) == ([-0.5, -1.0], [0.25, 1.0])


def test_settings_are_those_of_a_run():
    class Usual(Pole):
        presets: ClassVar = {"default": {"width": 0.2, "steps": 5, "policy": "linear"}, "other": {}}

    task = farm.environment(Usual, steps=7)._is.task
    assert (task.config.width, task.steps) == (0.2, 7)
    assert farm.environment(Usual(Usual.Config(steps=3)))._is.task.config.width == 0.6


class Whole(Pole):
    """Scores whole rollouts."""

    def score(self, record):
        """Nothing."""
        return farm.Score(terms=np.zeros((*record.actions.shape[:2], 1)))


@pytest.mark.parametrize(
    ("task", "settings", "message"),
    [
        (Whole, {}, r"task Whole scores whole rollouts \(score\), so a control step has no reward"),
        ("nothing", {}, "unknown task 'nothing'"),
        (3, {}, "task is a int; expected a farm.Task, its class, or its name"),
        (int, {}, "task is a type; expected a farm.Task"),
        (Pole, {"width": -1.0}, "width is -1.0"),
        (Pole, {"widht": 1.0}, "widht"),
        (Pole(), {"width": 0.5}, "width: the task is an object that has its settings"),
        (Pole, {"render_mode": "human"}, "render_mode is 'human'; expected 'rgb_array' or None"),
        (Pole, {"num_envs": 0}, "num_envs is 0; expected a whole number from 1 to 4096"),
        (Pole, {"num_envs": 2, "render_mode": "rgb_array"}, "render_mode is for one environment"),
    ],
)
def test_what_is_no_environment_is_one_line(task, settings, message):
    with pytest.raises(ConfigError, match=message) as error:
        farm.environment(task, **settings)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("action", [[0.0, 0.0], "x", [np.nan], None])
def test_an_action_that_is_none_is_one_line(action):
    env = farm.environment(Pole)
    env.reset()
    with pytest.raises(TaskError, match=r"action is .*; expected \(1,\) finite numbers"):
        env.step(action)


@pytest.mark.parametrize("actions", [np.zeros((1, 3)), np.zeros(3), np.full((3, 1), np.inf)])
def test_actions_of_another_shape_are_not_put_in_order(actions):
    envs = farm.environment(Pole, num_envs=3)
    envs.reset()
    with pytest.raises(TaskError, match=r"action is .*; expected \(3, 1\) finite numbers"):
        envs.step(actions)


def test_without_gymnasium_it_says_what_to_install():
    code = "import sys; sys.modules['gymnasium'] = None; import farm; farm.environment('pendulum')"
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert process.stderr.splitlines()[-1].endswith(
        "ConfigError: farm.environment needs gymnasium: pip install 'rolloutfarm[gym]'"
    )


def test_the_example_of_the_page_runs(monkeypatch):
    root = Path(__file__).parents[4]
    page = (root / "docs/gymnasium.md").read_text("utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.S)
    [block] = [each for each in blocks if "farm.environment" in each]
    monkeypatch.chdir(root)
    names = {}
    exec(block, names)
    assert names["x"].shape == (16, 3)


DRAW = """
import sys
sys.path[:0] = {path!r}
import numpy as np
import farm
from carts import Pole
from gymnasium.utils.env_checker import check_env
env = farm.environment(Pole, render_mode="rgb_array")
try:
    check_env(env)
    env.reset(seed=1)
    first, before = env.render(), env.render()
except farm.RunError as error:
    sys.exit(str(error))
while not any(env.step([1.0])[2:4]):
    pass
assert (first == before).all()
assert first.shape == (360, 480, 3) and first.dtype == np.uint8
assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10, "not empty"
assert (env.render() != first).any(), "it has moved"
assert env.render().shape == first.shape, "also after the end"
env.close()
assert farm.environment(Pole).render() is None
"""


def test_pictures_are_the_farms_own_and_checks_pass_with_them():
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    code = DRAW.format(path=[each for each in sys.path if each])
    command = [sys.executable, "-c", code]
    process = subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    if "MuJoCo cannot draw here" in process.stderr:
        pytest.skip("needs OSMesa or EGL")
    assert process.returncode == 0, process.stderr


@pytest.mark.parametrize("vector", [{}, {"num_envs": 2}])
def test_a_closed_environment_says_so(vector):
    env = farm.environment(Pole, **vector)
    env.reset(seed=1)
    env.close()
    for call in (lambda: env.step(env.action_space.sample()), env.reset):
        with pytest.raises(TaskError, match="the environment is closed; make another one"):
            call()
    env.close()
