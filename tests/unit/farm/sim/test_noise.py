"""`sim.noise` in rollouts: the same numbers in any batch, for both of a pair, and none at the
nominal start.
"""

import numpy as np
import pytest
from carts import Pole, new_runner, same, thetas

from farm.errors import TaskError

SEEDS = [None, (1, 2, 3, 4), (1, 2, 3, 4), (5, 0, 0, 0), None, (9, 9, 9, 9), (5, 0, 0, 0)]


class Noisy(Pole):
    """A pole whose readings, controls and reward have noise."""

    def observe(self, sim):
        """All readings have noise, and its own numbers are kept."""
        sim.own["seen"] = sim.noise(4, "seen")
        return super().observe(sim) + 0.05 * sim.own["seen"]

    def act(self, sim, action):
        """The motor flutters."""
        assert np.array_equal(sim.noise((2, 2), "seen").reshape(-1, 4), sim.own["seen"]), (
            "asked again"
        )
        return super().act(sim, action) + 0.1 * sim.noise(1, "motor", "uniform")

    def reward(self, sim, action):
        """So does the judge."""
        return {
            **super().reward(sim, action),
            "luck": sim.noise(stream="luck"),
            "t": np.full(len(sim), float(sim.t)),
        }


def test_noise_does_not_depend_on_the_batch_and_pairs_share_it():
    runner = new_runner(Noisy, width=0.3)
    theta = thetas(runner, 7, 4.0)
    together = runner.rollouts(theta, SEEDS)
    assert len(set(together.steps.tolist())) > 2, "some end early"
    for row in range(7):
        same(together, row, runner.rollouts(theta[row : row + 1], [SEEDS[row]]), 0)
    luck = together.terms[..., 2]
    both = min(together.steps[1:3])
    assert np.array_equal(luck[1, :both], luck[2, :both])
    assert not luck[[0, 4]].any(), "nominal"
    assert len(set(luck[1, :both].tolist()) | set(luck[5, :both].tolist())) > both


def test_a_task_that_draws_no_noise_has_the_numbers_it_had():
    runner = new_runner()
    quiet = new_runner(Noisy)
    quiet.task.observe = runner.task.observe  # type: ignore[method-assign]
    quiet.task.act = runner.task.act  # type: ignore[method-assign]
    theta = thetas(runner, 7, 4.0)
    one = runner.rollouts(theta, SEEDS)
    other = quiet.rollouts(theta, SEEDS)
    assert one.frames["qpos"].tobytes() == other.frames["qpos"].tobytes()


@pytest.mark.parametrize(("shape", "kind"), [(-1, "normal"), ((2, 0.5), "normal"), (1, "gaussian")])
def test_a_shape_or_kind_that_is_none_is_an_error(shape, kind):
    class Wrong(Pole):
        def observe(self, sim):
            """It asks wrongly."""
            return super().observe(sim) + sim.noise(shape, kind=kind)

    with pytest.raises(TaskError, match=r"sim.noise of shape .* expected"):
        new_runner(Wrong)
