"""A chain of gaits: which may follow each other, and when the next one acts."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import GRIPS
from farm.tasks.finger_gait.task import FingerGait
from learner.chain import chain
from learner.commands.chain import ChainCommand, check_lengths
from learner.config import configure
from learner.replay import LoadedPolicy
from learner.setup import problem

Make = Callable[..., LoadedPolicy]


@pytest.fixture(scope="module")
def gait() -> Make:
    """A gait whose policy commands its goal grip at once: direct, of one feature that is always 1."""

    @cache
    def make(start: str, goal: str, item: str = "bar") -> LoadedPolicy:
        config = configure(policy="direct", features=1, start_grip=start, goal_grip=goal, object=item)
        found = problem(config, {"frequencies": np.zeros((1, 8)), "phases": np.zeros(1)})
        assert isinstance(found.task, FingerGait)
        grasping = Grasping(found.task.hand)
        offset = grasping.command(GRIPS[goal]) - grasping.command(GRIPS[start])
        return LoadedPolicy(found, 0, offset / np.sqrt(2.0))

    return make


def drawn(count: int) -> list[tuple[int, ...]]:
    return [(seed,) for seed in range(count)]


def test_the_grip_changes_there_and_back_by_touch(gait: Make) -> None:
    add, remove = gait("index+thumb", "index+middle+thumb"), gait("index+middle+thumb", "index+thumb")
    done = chain([add, remove], drawn(3), 30)
    assert (done.changes >= 4).all()
    assert (done.acting[:, 0] == 0).all()
    for acting, force in zip(done.acting, done.rollouts.frames["force"].sum(axis=-1), strict=True):
        for t in np.flatnonzero(np.diff(acting)):  # the next policy acts because three steps felt the goal
            pressing = force[t - 2 : t + 1] >= 0.1
            assert (pressing == (True, acting[t] == 0, True)).all()


@pytest.mark.slow
def test_more_rollouts_than_are_stepped_together_are_the_same(gait: Make) -> None:
    policies = [gait("index+thumb", "index+middle+thumb"), gait("index+middle+thumb", "index+thumb")]
    many = chain(policies, drawn(66), 4)
    few = chain(policies, drawn(66)[65:], 4)
    assert np.array_equal(many.rollouts.frames["qpos"][65:], few.rollouts.frames["qpos"])


def test_gaits_that_do_not_follow_each_other(gait: Make) -> None:
    add = gait("index+thumb", "index+middle+thumb")
    with pytest.raises(ConfigError, match=r"ends in index\+middle\+thumb is not followed by one from index\+thumb"):
        chain([add], drawn(1), 3)
    with pytest.raises(ConfigError, match="simulate different models"):
        chain([add, gait("index+middle+thumb", "index+thumb", "thick-bar")], drawn(1), 3)


@pytest.mark.parametrize("flags", [{"shown": 2}, {"shown": 1001}, {"steps": 1001}], ids=str)
def test_lengths_that_a_task_does_not_take_are_refused_beforehand(gait: Make, flags: dict[str, int]) -> None:
    (flag, value), add = next(iter(flags.items())), gait("index+thumb", "index+middle+thumb")
    with pytest.raises(ConfigError, match=f"--{flag}: steps is {value}; expected 3 to 1000"):
        check_lengths([add], ChainCommand(runs=(), **flags))  # type: ignore[arg-type]
