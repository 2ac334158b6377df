"""An upper level over gaits: which may follow each other, and when the next one acts."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.thesis.chain import chain
from farm.errors import ConfigError
from farm.policies.fourier import Features, Policy, PolicyConfig
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import GRIPS
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.physics import Simulation
from farm.tasks.finger_gait.task import Perturbation
from learner.config import RunConfig
from learner.replay import Stored

Make = Callable[..., Stored]


@pytest.fixture(scope="module")
def gait() -> Make:
    """A gait whose policy commands its goal grip at once: direct, of one feature that is always 1."""

    def make(start: str, goal: str, item: str = "bar") -> Stored:
        config = replace(RunConfig(), task=replace(RunConfig().task, start_grip=start, goal_grip=goal, object=item))
        controller = PolicyConfig(controller="direct", features=1)
        nothing = Features(np.zeros((1, STATES["joints"].size)), np.zeros(1))
        simulation = Simulation(config.task, Policy(controller, STATES["joints"].size, nothing))
        grip = Grasping(simulation.scene).command(GRIPS[goal])
        return Stored(config, 0, (grip - simulation.task.commands) / np.sqrt(2.0), nothing, simulation)

    return make


def drawn(count: int, steps: int) -> list[Perturbation]:
    return [Perturbation.draw(np.random.default_rng(seed), steps) for seed in range(count)]


def test_the_grip_changes_there_and_back_by_touch(gait: Make) -> None:
    add, remove = gait("index+thumb", "index+middle+thumb"), gait("index+middle+thumb", "index+thumb")
    done = chain([add, remove], drawn(5, 30), 30)
    assert (done.changes >= 4).all()
    assert (done.acting[:, 0] == 0).all()
    for acting, force in zip(done.acting, done.force, strict=True):
        for t in np.flatnonzero(np.diff(acting)):  # the next policy acts because three steps felt the goal
            pressing = force[t - 2 : t + 1] >= 0.1
            assert (pressing == (True, acting[t] == 0, True)).all()


def test_more_rollouts_than_are_stepped_together_are_the_same(gait: Make) -> None:
    policies = [gait("index+thumb", "index+middle+thumb"), gait("index+middle+thumb", "index+thumb")]
    many = chain(policies, drawn(70, 6), 6)
    few = chain(policies, drawn(70, 6)[66:], 6)
    assert np.array_equal(many.force[66:], few.force)


def test_gaits_that_do_not_follow_each_other(gait: Make) -> None:
    add = gait("index+thumb", "index+middle+thumb")
    with pytest.raises(ConfigError, match=r"a gait to index\+middle\+thumb is not followed by one from index\+thumb"):
        chain([add], drawn(1, 3), 3)
    with pytest.raises(ConfigError, match="not followed"):
        chain([add, gait("index+middle+thumb", "index+thumb", "thick-bar")], drawn(1, 3), 3)
