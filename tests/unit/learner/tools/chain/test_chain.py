"""A chain of gaits: which may follow each other, and when the next one acts."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.policies.base import Policy, PolicyConfig
from farm.sim.sim import Sim
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import GRIPS
from farm.tasks.finger_gait.task import FingerGait
from learner.run.config import configure
from learner.run.setup import problem
from learner.tools.chain.chain import chain
from learner.tools.chain.command import ChainCommand, check_lengths
from learner.tools.replay.loaded import LoadedPolicy

pytestmark = pytest.mark.usefixtures("grips_found_once")

Make = Callable[..., LoadedPolicy]
GRIPS_OF_TWO = ("index+thumb", "index+middle+thumb")


@pytest.fixture(scope="module")
def gait() -> Make:
    """A gait whose policy commands its goal grip at once: direct, of one feature that is always
    1.
    """

    @cache
    def make(start: str, goal: str, item: str = "bar") -> LoadedPolicy:
        config = configure(
            policy="direct", features=1, start_grip=start, goal_grip=goal, object=item
        )
        climb = problem(config, {"frequencies": np.zeros((1, 8)), "phases": np.zeros(1)})
        assert isinstance(climb.task, FingerGait)
        grasping = Grasping(climb.task.hand)
        offset = grasping.command(GRIPS[goal]) - grasping.command(GRIPS[start])
        return LoadedPolicy(climb, 0, offset / np.sqrt(2.0))

    return make


def starts(count: int) -> list[tuple[int, ...]]:
    return [(seed,) for seed in range(count)]


def test_the_grip_changes_there_and_back_by_touch(gait: Make) -> None:
    add = gait("index+thumb", "index+middle+thumb")
    remove = gait("index+middle+thumb", "index+thumb")
    done = chain([add, remove], starts(3), 30)
    assert (done.changes >= 4).all()
    assert (done.acting[:, 0] == 0).all()
    for acting, force in zip(done.acting, done.rollouts.frames["force"].sum(axis=-1), strict=True):
        # The next policy acts because three steps felt the goal
        for t in np.flatnonzero(np.diff(acting)):
            pressing = force[t - 2 : t + 1] >= 0.1
            assert (pressing == (True, acting[t] == 0, True)).all()


class Counts(Policy):
    """Commands its parameters, and a millionth of a radian more for each step that it acted
    before.
    """

    size = 8
    memory = np.zeros(1)

    def act(self, prepared, x, memory):  # type: ignore[override]
        """Count."""
        return prepared + 1e-6 * memory, memory + 1.0


def test_a_policy_with_memory_begins_anew_whenever_its_turn_comes(gait: Make) -> None:
    links = [gait("index+thumb", "index+middle+thumb"), gait("index+middle+thumb", "index+thumb")]
    counts = [
        replace(
            link,
            problem=replace(link.problem, policy=Counts(PolicyConfig(), link.problem.spec, {})),
            mu=link.mu * np.sqrt(2.0),
        )
        for link in links
    ]
    done, plain = chain(counts, starts(3), 30), chain(links, starts(3), 30)
    assert np.array_equal(done.acting, plain.acting)
    for acting, controls in zip(
        done.acting, done.rollouts.actions - plain.rollouts.actions, strict=True
    ):
        memories, count = np.rint(controls.max(axis=1) * 1e6).astype(int).tolist(), 0
        for t in range(30):
            count = count + 1 if t and acting[t] == acting[t - 1] else 0
            assert memories[t] == count
    assert (done.changes >= 4).all()


class Pushes(FingerGait):
    """Pushes the object when and where it acts."""

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """[N]"""
        sim.xfrc_applied[:, -1, 0] = 1e-3 * (1 + GRIPS_OF_TWO.index(self.config.start_grip))
        return super().act(sim, action)


def test_only_the_policy_whose_turn_it_is_writes_states(
    gait: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    links = [gait(*GRIPS_OF_TWO), gait(*reversed(GRIPS_OF_TWO))]
    pushing = [
        replace(
            each,
            problem=replace(
                each.problem, task=Pushes(each.problem.task.config, files=each.problem.task.sources)
            ),
        )
        for each in links
    ]
    forces: list[FloatArray] = []
    monkeypatch.setattr(
        Pushes,
        "reached",
        lambda self, sim: (
            forces.append(sim.xfrc_applied[:, -1, 0].copy()) or FingerGait.reached(self, sim)
        ),
    )
    done = chain(pushing, starts(2), 20)
    applied = np.array(forces[::2])
    for t, acting in enumerate(done.acting.T):
        if (acting >= 0).all():
            assert np.array_equal(applied[t], 1e-3 * (1 + acting))
    assert {0, 1} <= set(done.acting.ravel().tolist())


@pytest.mark.slow
def test_more_rollouts_than_are_stepped_together_are_the_same(gait: Make) -> None:
    policies = [
        gait("index+thumb", "index+middle+thumb"),
        gait("index+middle+thumb", "index+thumb"),
    ]
    many = chain(policies, starts(66), 4)
    few = chain(policies, starts(66)[65:], 4)
    assert np.array_equal(many.rollouts.frames["qpos"][65:], few.rollouts.frames["qpos"])


def test_gaits_that_do_not_follow_each_other(gait: Make) -> None:
    add = gait("index+thumb", "index+middle+thumb")
    with pytest.raises(
        ConfigError, match=r"ends in index\+middle\+thumb is not followed by one from index\+thumb"
    ):
        chain([add], starts(1), 3)
    with pytest.raises(ConfigError, match="simulate different models"):
        chain([add, gait("index+middle+thumb", "index+thumb", "thick-bar")], starts(1), 3)


SWINGS = """import numpy as np
import farm

class Swings(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/></body>
      </worldbody><actuator><position joint="a" ctrlrange="-1 1"/></actuator></mujoco>'''
    steps = 5
    actions = farm.Rhythm(("a",), (0.0,), swing={"": 0.3}, name="{limb}{joint}")
    ends = ("here", "here")

    def reward(self, sim, action):
        return np.ones(len(sim))

    def reached(self, sim):
        return np.zeros(len(sim), dtype=bool)

    lost = reached
"""


def test_an_action_space_that_remembers_the_start_cannot_be_chained(tmp_path: Path) -> None:
    path = tmp_path / "swings.py"
    path.write_text(SWINGS)
    swings = problem(configure(f"{path}:Swings", policy="linear"))
    with pytest.raises(ConfigError, match="cannot be chained: its Rhythm remembers how a rollout"):
        chain([LoadedPolicy(swings, 0, np.zeros(swings.policy.size))], starts(1), 5)


@pytest.mark.parametrize("flags", [{"shown": 2}, {"shown": 1001}, {"steps": 1001}], ids=str)
def test_lengths_that_a_task_does_not_take_are_refused_beforehand(
    gait: Make, flags: dict[str, int]
) -> None:
    (flag, value), add = next(iter(flags.items())), gait("index+thumb", "index+middle+thumb")
    with pytest.raises(ConfigError, match=f"--{flag}: steps is {value}; expected 3 to 1000"):
        check_lengths([add], ChainCommand(runs=(), **flags))  # type: ignore[arg-type]
