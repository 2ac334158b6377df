"""Environments of Gymnasium whose observations are dictionaries, as those with goals: a tiny one of
the test's own.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, OneOf, Tuple, flatdim, flatten

from farm.errors import ConfigError, TaskError
from farm.policies.networks import Linear, LinearConfig
from farm.runner import Runner
from farm.tasks.gymnasium import Environment, EnvironmentConfig, reset_seed
from farm.tasks.loop import Batch
from farm.tasks.standard import standard

XML = """<mujoco><option timestep="0.01"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
  <geom size="0.1" mass="1"/></body></worldbody>
  <actuator><motor joint="x"/></actuator></mujoco>"""
NUMBERS = Box(-np.inf, np.inf, (2,))


class Goal(gymnasium.Env[Any, Any]):
    """A cart with a goal.

    Its reset leaves applied forces and the solver's state, as those of some environments do.
    """

    dt = 0.05

    def __init__(self, part: str = "") -> None:
        """`part` is what makes it unusable."""
        self.model = mujoco.MjModel.from_xml_string(XML)
        self.data = mujoco.MjData(self.model)
        odd: dict[str, Any] = {
            "one": OneOf((NUMBERS, NUMBERS)),
            "mode": Discrete(4),
            "eye": Box(0, 255, (8, 8, 3), np.uint8),
            "cube": Box(-1.0, 1.0, (2, 2, 2)),
        }
        self.observation_space = Dict(
            {
                "observation": NUMBERS,
                "goals": Tuple((Box(-1.0, 1.0, (1,)), Box(-1.0, 1.0, (1, 1), np.float64))),
                **({part: odd[part]} if part else {}),
            }
        )
        self.action_space = Box(-1.0, 1.0, (2,))  # of which the model knows one

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Draw a goal and a place."""
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1.0, 1.0, 1)
        self.data.qpos[:], self.data.qvel[:] = self.np_random.uniform(-0.1, 0.1, 1), 0.0
        mujoco.mj_forward(self.model, self.data)
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """It is pushed by a force that adds up."""
        self.data.xfrc_applied[1, 0] += action[1]
        self.data.ctrl[:] = action[0]
        mujoco.mj_step(self.model, self.data, 5)
        gap = abs(float(self.data.qpos[0] - self.goal[0]))
        return self._seen(), -gap, gap < 0.01, False, {}

    def _seen(self) -> dict[str, Any]:
        state = np.concatenate([self.data.qpos, self.data.qvel]).astype(np.float32)
        return {
            "observation": state,
            "goals": (self.data.qpos.astype(np.float32), self.goal[None].copy()),
        }


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Only during a test."""
    gymnasium.register("Goal-v0", Goal, max_episode_steps=12)
    yield
    del gymnasium.registry["Goal-v0"]


def new_runner() -> Runner:
    task = Environment(EnvironmentConfig(), "Goal-v0")
    return Runner(task, Linear(LinearConfig(), task.spec(), standard(task, 0.5)))


def test_a_goal_environment_is_a_plain_loop_with_gymnasiums_own_flatten() -> None:
    runner = new_runner()
    theta = np.random.default_rng(0).normal(size=(1, runner.size))
    env: Any = gymnasium.make("Goal-v0")
    assert runner.spec.observation == flatdim(env.observation_space) == 4
    rollouts = runner.rollouts(theta, [(3,)])
    x, _ = env.reset(seed=reset_seed(np.random.default_rng((3,))))
    prepared, rewards, over = runner.policy.prepare(theta), [], False
    while not over:
        flat = flatten(env.observation_space, x)
        assert isinstance(flat, np.ndarray)
        action = np.clip(runner.policy.act(prepared, flat[None])[0], -1.0, 1.0).astype(np.float32)
        x, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        over = terminated or truncated
    assert rollouts.terms[0, : len(rewards), 0].tolist() == rewards
    assert rollouts.frames["qpos"][0, len(rewards) - 1].tolist() == env.unwrapped.data.qpos.tolist()


def test_what_a_reset_leaves_does_not_reach_later_rollouts() -> None:
    runner, seeds = new_runner(), [(1,), None, (2,), (3,)]
    theta = np.random.default_rng(0).normal(size=(4, runner.size))
    first, again = runner.rollouts(theta, seeds), runner.rollouts(theta[::-1], seeds[::-1])
    assert first.frames["qpos"].tobytes() == again.frames["qpos"][::-1].tobytes()
    assert first.returns.tobytes() == again.returns[::-1].tobytes()


def test_an_environments_state_is_its_own() -> None:
    class Moves(Environment):
        def act(self, sim: Any, action: np.ndarray) -> np.ndarray:
            sim.qpos[:] = 0.0
            return super().act(sim, action)

    batch = Batch(Moves(EnvironmentConfig(), "Goal-v0"), new_runner().sim, [None])
    with pytest.raises(
        TaskError, match=r"sim.qpos can be written in .*, and in no environment of Gymnasium"
    ):
        batch.step(np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("part", "line"),
    [
        (
            "mode",
            (
                r"task gym:Goal-v0: observation\['mode'\] is Discrete\(4\); expected numbers: a"
                r" box, or a dict of boxes"
            ),
        ),
        (
            "one",
            r"observation\['one'\] is OneOf\(.*\); expected numbers: a box, or a dict of boxes",
        ),
        (
            "eye",
            (
                r"observation\['eye'\] is Box\(0, 255, \(8, 8, 3\), uint8\), a picture; expected"
                r" numbers"
            ),
        ),
        (
            "cube",
            (
                r"observation\['cube'\] is Box\(-1.0, 1.0, \(2, 2, 2\), float32\), a picture;"
                r" expected numbers"
            ),
        ),
    ],
)
def test_parts_that_are_no_numbers_are_named(part: str, line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        Environment(EnvironmentConfig(env_arg=(f'part="{part}"',)), "Goal-v0")


class Wrapped:
    """A thing of dm_control's, around one of MuJoCo's."""

    def __init__(self, ptr: Any) -> None:
        self.ptr = ptr


class Physics:
    """dm_control's: it raises an exception where MuJoCo only warns, unless it is told not to."""

    def __init__(self) -> None:
        self._own = mujoco.MjModel.from_xml_string(XML)
        self._data, self._quiet = mujoco.MjData(self._own), False
        self.model, self.data = Wrapped(self._own), Wrapped(self._data)

    @contextmanager
    def suppress_physics_errors(self) -> Iterator[None]:
        """For a block."""
        self._quiet = True
        yield
        self._quiet = False

    def step(self) -> None:
        """As dm_control's."""
        before = [each.number for each in self._data.warning]
        mujoco.mj_step(self._own, self._data)
        if before != [each.number for each in self._data.warning] and not self._quiet:
            raise ArithmeticError("physics")


class Suite(gymnasium.Env[Any, Any]):
    """As shimmy gives dm_control's environments: without a model of its own, with an old generator
    and a limit.
    """

    dt = 0.05
    observation_space, action_space = Box(-np.inf, np.inf, (2,)), Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self.physics, self._left = Physics(), 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """From a seed of 32 bits."""
        data = self.physics.data.ptr
        data.qpos[:] = np.random.RandomState(seed).uniform(-0.1, 0.1)
        data.qvel[:] = 0.0
        self._left = 7
        return np.concatenate([data.qpos, data.qvel]), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """It ends itself after 7 steps, and may not be stepped on."""
        assert self._left
        self._left -= 1
        data = self.physics.data.ptr
        data.ctrl[:] = action
        if data.qpos[0] > 0.05:
            data.qvel[:] = 1e12
        self.physics.step()
        return np.concatenate([data.qpos, data.qvel]), 1.0, False, not self._left, {}


@pytest.mark.parametrize("steps", [5, 7, 9])
def test_dm_controls_physics_seeds_and_limit(steps: int) -> None:
    gymnasium.register("suite/push-v0", Suite)
    try:
        task = Environment(EnvironmentConfig(steps=steps), "suite/push-v0")
        runner = Runner(task, Linear(LinearConfig(), task.spec(), {}))
        rollouts = runner.rollouts(np.zeros((20, runner.size)), [(each,) for each in range(20)])
    finally:
        del gymnasium.registry["suite/push-v0"]
    assert 0 < rollouts.failed.sum() < 20
    fine = ~rollouts.failed
    assert set(rollouts.steps[fine].tolist()) == {min(steps, 7)}
    assert rollouts.returns[fine].tolist() == [min(steps, 7)] * fine.sum()
    assert rollouts.ended[fine].all() == rollouts.ended[fine].any() == (steps > 7)
