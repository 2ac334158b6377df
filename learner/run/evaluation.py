"""What a round says in numbers, and the evaluation of the mean policy: its jobs and their
results.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import BoolArray, FloatArray
from farm.net.work import Jobs, Simulated
from farm.returns import known, mean, penalised
from farm.sim.trajectory import Trajectory
from farm.tasks.base import TaskSpec
from learner.run.config import VALIDATION_ROLLOUTS, RunConfig
from learner.scheduler.round import RoundResults

EVALUATION_ROLLOUTS: Final = 100
"""Number of rollouts of the evaluation at the end of a run, and default of `farm evaluate`."""

EVALUATION_SEED: Final = 0
"""Its seed."""


@dataclass(frozen=True)
class Nominal:
    """The mean policy's rollout under nominal conditions, at physics rate."""

    value: float | None
    """Its return; None if it failed."""
    success: bool | None
    """None if the task does not define success."""
    trajectory: Trajectory | None


@dataclass(frozen=True)
class Evaluation:
    """Evaluation at the end of a run: the mean policy, unperturbed and perturbed."""

    mean: Nominal
    robust_success_rate: float | None
    """Share of the perturbed rollouts that succeeded; None if the task does not define success."""
    robust_return: float | None
    """Mean return of the perturbed rollouts that have one; None if none has."""
    robust_failed: int
    """Number of the perturbed rollouts that failed."""
    robust_score: float | None
    """Their mean return, with `farm.returns.penalised` for those that failed: what policies are
    compared by.
    """
    measures: tuple[dict[str, float | None], dict[str, float | None]]
    """The task's measures by name: of the nominal rollout, and means over the perturbed ones that
    did not fail.
    """
    without_learning: dict[str, Any] | None
    """From the same starts what doing nothing and the best constant action give; None if it was not
    measured.
    """
    replay: Trajectory | None
    """The best rollout of the run at physics rate, if it has not been reported yet."""


def evaluation_jobs(rollouts: int, seed: int) -> Jobs:
    """Jobs of the mean policy on perturbed starts, and last on the nominal one at physics rate."""
    trials = Jobs.mean("none", [seeds.trial(seed, i) for i in range(rollouts)])
    return Jobs.joined([*([trials] if rollouts else []), Jobs.mean("physics", [None])])


def validation_jobs(config: RunConfig, generation: int, rollouts: int) -> list[Jobs]:
    """Jobs of the mean policy that validate it in a generation with this number of exploring
    rollouts, if it does.
    """
    return [starts_of_validation(config)] if config.validates(generation, rollouts) else []


def whole_round(config: RunConfig, generation: int, exploring: Jobs) -> Jobs:
    """The jobs of a generation that is repeated: those that explore, the mean policy's, and those
    of validation.
    """
    validating = validation_jobs(config, generation, int(exploring.rollouts.sum()))
    return Jobs.joined([exploring, Jobs.mean("none", [None]), *validating])


def starts_of_validation(config: RunConfig) -> Jobs:
    """Jobs of the mean policy from the starts by which the run's policies are compared."""
    return Jobs.mean(
        "none", [seeds.validation(config.seed, start) for start in range(VALIDATION_ROLLOUTS)]
    )


def validation(
    config: RunConfig, generation: int, rollouts: int, returns: FloatArray
) -> float | None:
    """The score of the mean policy, from the returns of all jobs of such a generation, of which the
    last validate.
    """
    return score(returns[-VALIDATION_ROLLOUTS:]) if config.validates(generation, rollouts) else None


def outcome(spec: TaskSpec, results: RoundResults | Simulated, rollouts: int) -> dict[str, Any]:
    """The part of GenerationStats that follows from a round: exploring rollouts, then the mean
    policy's.
    """
    returns, flags = results.returns[:rollouts], results.flags[:rollouts]
    return {
        **statistics(returns),
        "mean_policy_return": mean(results.returns[rollouts : rollouts + 1]),
        "mean_policy_success": bool(results.flags[rollouts, 0]) if spec.success else None,
        "success_rate": success_rate(spec, flags),
        "ended": int(np.count_nonzero(flags[:, 1])),
        "failed": failures(flags),
        "clamped": int(np.count_nonzero(flags[:, 3])),
        "measures": means_of_measures(spec, results, slice(rollouts)),
        "mean_policy_measures": means_of_measures(spec, results, slice(rollouts, rollouts + 1)),
    }


def statistics(returns: FloatArray) -> dict[str, float | None]:
    """Mean, extremes and standard deviation of the returns that rollouts (S,) have; None if none
    has one.
    """
    values = returns[known(returns)]
    if not values.size:
        return dict.fromkeys(("return_mean", "return_min", "return_max", "return_std"))
    return {
        "return_mean": float(values.mean()),
        "return_min": float(values.min()),
        "return_max": float(values.max()),
        "return_std": float(values.std()),
    }


def failures(flags: BoolArray) -> int:
    """Number of rollouts (S, 4) that failed, or whose return overflowed."""
    return int(np.count_nonzero(flags[:, 2] | flags[:, 3]))


def score(returns: FloatArray) -> float | None:
    """Mean return (S,) by which policies are compared, with failed rollouts as penalised; None if
    all failed.
    """
    return float(penalised(returns).mean()) if known(returns).any() else None


def success_rate(spec: TaskSpec, flags: BoolArray) -> float | None:
    """Fraction of the rollouts (S, 4) that succeeded; None if the task does not define success."""
    return float(np.mean(flags[:, 0])) if spec.success else None


def means_of_measures(
    spec: TaskSpec, results: RoundResults | Simulated, rows: slice
) -> dict[str, float | None]:
    """Means of the task's measures over rollouts that did not fail, by name."""
    sound = np.flatnonzero(~results.flags[rows, 2])
    columns = enumerate(each.name for each in spec.measures)
    return {
        name: float(results.measures[rows][sound, at].mean()) if sound.size else None
        for at, name in columns
    }
