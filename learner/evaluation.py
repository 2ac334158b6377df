"""The mean policy, by itself: as jobs, and what they gave."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from farm import seeds as randomness
from farm.net.jobs import Job
from farm.net.results import Result
from farm.sim.trajectory import Trajectory

EVALUATION_ROLLOUTS: Final = 100
"""Rollouts of the evaluation at the end of a run, and of a plain `farm evaluate`."""

EVALUATION_SEED: Final = 0
"""Its seed."""

_ZERO: Final = np.empty(0)  # an eps of zeros, on the wire


@dataclass(frozen=True)
class Evaluation:
    """The end of a run: the mean policy, unperturbed and perturbed."""

    mean: Result
    """One rollout under nominal conditions, at physics rate."""
    robust_success_rate: float | None
    """Part of the perturbed rollouts that succeeded; None where the task knows no success."""
    robust_return: float
    """Mean return of the perturbed rollouts."""
    replay: Trajectory | None
    """The best rollout of the run at physics rate, if it has not been shown yet."""


def evaluation_jobs(rollouts: int, seed: int) -> list[Job]:
    """The mean policy on perturbed starts, and last on the nominal one at physics rate."""
    trials = [mean_job(i, rate="none", perturbation=randomness.trial(seed, i)) for i in range(rollouts)]
    return [*trials, mean_job(rollouts, rate="physics", perturbation=None)]


def mean_job(index: int, rate: str, perturbation: tuple[int, ...] | None) -> Job:
    """One rollout of the mean policy."""
    return Job(index=index, origin="mu", signs=(1,), perturbation=perturbation, rate=rate, eps=_ZERO)
