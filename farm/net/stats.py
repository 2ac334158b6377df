"""Statistics of a finished generation: one line of progress.jsonl. Pure data."""

from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from typing import Any, Final, get_origin

VERSION: Final = 2
"""Version of a line of progress.jsonl."""


@dataclass(frozen=True, kw_only=True)
class GenerationStats:
    """One generation.

    Returns, rates and counts are over all its exploring rollouts; mu and sigma after the update.
    """

    generation: int
    """Number of updates so far including this one: 1, 2, ..."""
    rollouts: int
    """Exploring rollouts of the run so far."""
    return_mean: float | None
    """Mean, least, greatest and standard deviation of the returns of rollouts that have one; None
    if none has.
    """
    return_min: float | None
    return_max: float | None
    return_std: float | None
    best: float | None
    """Best return of the run so far; with several episodes, the best mean over them.

    None if none had a return.
    """
    baseline: float | None
    """Baseline after the update, None where the algorithm has none."""
    mean_policy_return: float | None
    """Return of the mean policy that the generation explored around, unperturbed; None if it
    failed.
    """
    mean_policy_success: bool | None
    """Whether that rollout succeeded, None if the task does not define success."""
    success_rate: float | None
    """Fraction of rollouts that succeeded, None if the task does not define success."""
    sigma_mean: float
    sigma_min: float
    sigma_max: float
    mean_norm: float
    """Euclidean norm of mu."""
    ended: int
    """Rollouts that the task ended before their last step."""
    failed: int
    """Rollouts that failed: the simulation became unstable, their task raised an error, or the
    return overflowed.
    """
    clamped: int
    """Rollouts without a return: those that failed, unless their task scores whole rollouts."""
    reissued: int
    """Jobs reissued since the run's start (lost workers, stragglers, idle workers)."""
    workers: int
    seconds: float
    """Wall time of the run so far, including the time before it was resumed [s]."""
    measures: dict[str, Any] = field(default_factory=dict)
    """Means of the task's measures over the exploring rollouts that did not fail, by name; None if
    all failed.
    """
    mean_policy_measures: dict[str, Any] = field(default_factory=dict)
    """Values of the task's measures in the mean policy's rollout, by name."""
    validation: float | None = None
    """Mean return of the same mean policy from the starts of validation, failed rollouts penalised;
    None where it was not measured, or all failed.
    """

    def to_dict(self) -> dict[str, Any]:
        """Convert to a record of progress.jsonl; measures only where the task has some, validation
        only where it is known.
        """
        values = {name: value for name, value in vars(self).items() if value != {}}
        if self.validation is None:
            del values["validation"]
        return {"version": VERSION, **values}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "GenerationStats":
        """Make it from a record of progress.jsonl.

        Raises:
          ValueError: another version, or a field is missing or of another type.
        """
        version = values.get("version") if isinstance(values, dict) else None
        if type(version) is not int or version != VERSION:
            raise ValueError(f"not a line of progress.jsonl, version {VERSION}: {str(values)[:80]}")
        types = _types(cls)
        missing = [name for name, (_, needed) in types.items() if needed and name not in values]
        if missing:
            raise ValueError(f"progress line without {', '.join(missing)}")
        arguments: dict[str, Any] = {name: values[name] for name in types if name in values}
        for name, value in arguments.items():
            if not isinstance(value, types[name][0]):
                raise ValueError(f"progress line whose {name} is {str(value)[:40]!r}")
        stats = cls(**arguments)
        for each in (*stats.measures.values(), *stats.mean_policy_measures.values()):
            if not isinstance(each, int | float | None):
                raise ValueError(f"progress line with a measure that is {str(each)[:40]!r}")
        return stats


@cache
def _types(kind: type) -> dict[str, tuple[Any, bool]]:
    """The type of each field, and whether it must be there; cached, as a run has many lines."""
    return {
        each.name: (
            dict if get_origin(each.type) is dict else each.type,
            each.default is MISSING and each.default_factory is MISSING,
        )
        for each in fields(kind)
    }
