"""Figures of a round, and the evaluation of the mean policy: its jobs and their
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
from learner.pool.round import RoundResults
from learner.run.config import VALIDATION_ROLLOUTS, RunConfig
from learner.run.parts import Parts

EVALUATION_ROLLOUTS: Final = 100
"""Number of rollouts of the evaluation at the end of a run, and default of `farm evaluate`."""

EVALUATION_SEED: Final = 0
"""Seed of the evaluation at the end of a run."""


@dataclass(frozen=True)
class Nominal:
    """The mean policy's rollout under nominal conditions, at physics rate."""

    value: float | None
    """Return of the rollout; None if it failed."""
    success: bool | None
    """Whether the rollout succeeded; None if the task does not define success."""
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
    """Mean return of the perturbed rollouts, failed ones by `farm.returns.penalised`; policies are
    compared by it.
    """
    measures: tuple[dict[str, float | None], dict[str, float | None]]
    """The task's measures by name: of the nominal rollout, and means over the perturbed ones that
    did not fail.
    """
    without_learning: dict[str, Any] | None
    """Figures of doing nothing and of the best constant action, from the same starts; None if they
    were not measured.
    """
    replay: Trajectory | None
    """The best rollout of the run at physics rate, if it has not been reported yet."""


NOMINAL: Final = Jobs.mean("physics", [None])
"""The mean policy's nominal rollout."""


def starts_of_evaluation(rollouts: int, seed: int) -> Jobs:
    """Jobs of the mean policy on perturbed starts."""
    return Jobs.mean("none", [seeds.evaluation_start(seed, i) for i in range(rollouts)])


def evaluation_jobs(rollouts: int, seed: int) -> Jobs:
    """Jobs of the mean policy on perturbed starts, and last on the nominal one."""
    return Parts(starts=starts_of_evaluation(rollouts, seed), nominal=NOMINAL).jobs


def whole_round(
    config: RunConfig,
    generation: int,
    explore: Jobs,
    *,
    rate: str = "none",
    replay: Jobs | None = None,
) -> Parts:
    """The jobs of a generation: `explore`, the `mean` policy's, perhaps `replay` and `validate`.

    Args:
      config: of the run.
      generation: its number, from 0.
      explore: the exploring ones.
      rate: of the mean policy's trajectory.
      replay: of the best rollout so far.
    """
    validates = config.validates(generation, int(explore.rollouts.sum()))
    return Parts(
        explore=explore,
        mean=Jobs.mean(rate, [None]),
        replay=replay,
        validate=starts_of_validation(config) if validates else None,
    )


def starts_of_validation(config: RunConfig) -> Jobs:
    """Jobs of the mean policy from the starts by which the run's policies are compared."""
    return Jobs.mean(
        "none", [seeds.validation(config.seed, start) for start in range(VALIDATION_ROLLOUTS)]
    )


def validation(parts: Parts, returns: FloatArray) -> float | None:
    """The validated score of the mean policy in a round with these returns, if there is one."""
    return score(returns[parts.rows("validate")]) if "validate" in parts else None


def outcome(spec: TaskSpec, results: RoundResults | Simulated, parts: Parts) -> dict[str, Any]:
    """The part of GenerationStats that follows from the results of `whole_round`."""
    explore = parts.rows("explore")
    of_mean = parts.rows("mean")
    flags = results.flags[explore]
    return {
        **statistics(results.returns[explore]),
        "mean_policy_return": mean(results.returns[of_mean]),
        "mean_policy_success": bool(results.flags[of_mean, 0].all()) if spec.success else None,
        "success_rate": success_rate(spec, flags),
        "ended": int(np.count_nonzero(flags[:, 1])),
        "failed": failures(flags),
        "clamped": int(np.count_nonzero(flags[:, 3])),
        "measures": means_of_measures(spec, results, explore),
        "mean_policy_measures": means_of_measures(spec, results, of_mean),
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
