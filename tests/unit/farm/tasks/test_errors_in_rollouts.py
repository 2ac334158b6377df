"""A rollout in which a task raises an error, or gives no number, fails alone and changes nothing of
the others.
"""

import numpy as np
import pytest
from carts import Pole, arrays, new_runner, same, thetas

from farm.errors import TaskError
from farm.returns import RETURN_FLOOR
from farm.sim.channels import Measure

SEEDS = [None, *((i, 2, 3, 4) for i in range(12))]


def tilted(sim) -> np.ndarray:
    """Which rollouts have tilted to one side, as some do from every batch."""
    return sim.qpos[:, 1] > 0.15


def raises(sim) -> None:
    if tilted(sim).any():
        raise ZeroDivisionError(f"tilted in step {sim.t}")


class Raises(Pole):
    measures = (Measure(name="turned", low=-9.0, high=9.0),)

    def outcomes(self, record):
        return {"turned": np.clip(record.frames["angle"][:, -1, 0], -9.0, 9.0)}


class InReward(Raises):
    def reward(self, sim, action):
        raises(sim)
        return super().reward(sim, action)


class InObserve(Raises):
    def observe(self, sim):
        raises(sim)
        return super().observe(sim)


class InAct(Raises):
    def act(self, sim, action):
        raises(sim)
        return super().act(sim, action)


class NoReward(Raises):
    def reward(self, sim, action):
        terms = super().reward(sim, action)
        return terms | {"near": np.where(tilted(sim), np.nan, terms["near"])}


class NoObservation(Raises):
    def observe(self, sim):
        x = super().observe(sim)
        return np.where(tilted(sim)[:, None], np.inf, x)


class InReset(Raises):
    def reset(self, sim, row, rng):
        super().reset(sim, row, rng)
        if rng is not None and sim.qpos[row, 1] > 0.02:
            raise ZeroDivisionError("tilted at the start")


class Whole(InReward):
    """Scores whole rollouts, and raises where there is nothing to score."""

    def score(self, record):
        from farm import Score

        if (record.frames["angle"] > 0.15).any():
            raise ZeroDivisionError("tilted")
        return Score(terms=-np.abs(record.frames["angle"]))


KINDS = [InReward, InObserve, InAct, NoReward, NoObservation, InReset, Whole]


@pytest.mark.parametrize("kind", KINDS)
def test_it_fails_alone(kind):
    runner = new_runner(kind)
    theta = thetas(runner, len(SEEDS), 4.0)
    rollouts = runner.rollouts(theta, SEEDS)
    assert 0 < rollouts.failed.sum() < len(SEEDS)
    assert (rollouts.returns[rollouts.failed] == RETURN_FLOOR).all()
    assert rollouts.clamped.tolist() == rollouts.failed.tolist()
    assert not rollouts.success[rollouts.failed].any()
    assert rollouts.measures[rollouts.failed, 0].tolist() == [-9.0] * int(rollouts.failed.sum())
    assert runner.trouble.errors, "why"
    for row in range(len(SEEDS)):
        same(rollouts, row, runner.rollouts(theta[row : row + 1], [SEEDS[row]]), 0)
    order = np.random.default_rng(0).permutation(len(SEEDS))
    permuted = runner.rollouts(theta[order], [SEEDS[i] for i in order])
    for at, row in enumerate(order.tolist()):
        same(rollouts, row, permuted, at)


@pytest.mark.parametrize("kind", KINDS)
def test_the_others_are_as_if_nothing_had_been_raised(kind):
    runner, plain = new_runner(kind), new_runner(Raises)
    theta = thetas(runner, len(SEEDS), 4.0)
    rollouts, sound = runner.rollouts(theta, SEEDS), plain.rollouts(theta, SEEDS)
    scored = {"terms", "returns"} if kind is Whole else set()
    for row in np.flatnonzero(~rollouts.failed):
        for name, values in arrays(rollouts).items():
            if name not in scored:
                assert values[row].tobytes() == arrays(sound)[name][row].tobytes(), name


@pytest.mark.parametrize("kind", KINDS)
def test_a_strict_task_ends_at_the_first(kind):
    runner = new_runner(kind, strict=True)
    with pytest.raises(
        (ZeroDivisionError, TaskError), match=r"tilted|not finite in|not finite before"
    ):
        runner.rollouts(thetas(runner, len(SEEDS), 4.0), SEEDS)


def test_what_may_be_this_machine_is_raised():
    for error in (MemoryError(), OSError("no space"), ImportError("no module")):

        class Lacks(Pole):
            def reward(self, sim, action, error=error):
                if sim.t == 2:
                    raise error
                return super().reward(sim, action)

        runner = new_runner(Lacks)
        with pytest.raises(type(error)):
            runner.rollouts(thetas(runner, 2), [None, (1, 2, 3, 4)])
