"""Evaluation of the mean policy: its jobs and their results."""

from dataclasses import dataclass
from typing import Final

from farm import seeds
from farm.net.work import Jobs
from farm.sim.trajectory import Trajectory

EVALUATION_ROLLOUTS: Final = 100
"""Number of rollouts of the evaluation at the end of a run, and default of `farm evaluate`."""

EVALUATION_SEED: Final = 0
"""Its seed."""


@dataclass(frozen=True)
class Nominal:
    """The mean policy's rollout under nominal conditions, at physics rate."""

    value: float
    """Its return."""
    success: bool | None
    """None if the task does not define success."""
    trajectory: Trajectory | None


@dataclass(frozen=True)
class Evaluation:
    """Evaluation at the end of a run: the mean policy, unperturbed and perturbed."""

    mean: Nominal
    robust_success_rate: float | None
    """Share of the perturbed rollouts that succeeded; None if the task does not define success."""
    robust_return: float
    """Mean return of the perturbed rollouts."""
    replay: Trajectory | None
    """The best rollout of the run at physics rate, if it has not been reported yet."""


def evaluation_jobs(rollouts: int, seed: int) -> Jobs:
    """Jobs of the mean policy on perturbed starts, and last on the nominal one at physics rate."""
    trials = Jobs.mean("none", [seeds.trial(seed, i) for i in range(rollouts)])
    return Jobs.joined([*([trials] if rollouts else []), Jobs.mean("physics", [None])])
