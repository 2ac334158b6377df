"""Statistics of a finished generation: one line of progress.jsonl. Pure data."""

from dataclasses import dataclass, fields
from typing import Any, Final, cast

VERSION: Final = 2
"""Version of a line of progress.jsonl."""


@dataclass(frozen=True, kw_only=True)
class GenerationStats:
    """One generation. Returns, rates and counts are over its 2N exploring rollouts."""

    generation: int
    """Number of updates so far including this one: 1, 2, ..."""
    rollouts: int
    """Exploring rollouts of the run so far."""
    return_mean: float
    """Mean return."""
    return_min: float
    """Lowest return."""
    return_max: float
    """Highest return."""
    return_std: float
    """Standard deviation of the returns."""
    best: float
    """Best return of the run so far."""
    baseline: float | None
    """Baseline after the update, None where the algorithm has none."""
    mean_policy_return: float
    """Return of the mean policy that the generation explored around, unperturbed."""
    mean_policy_success: bool | None
    """Whether that rollout succeeded, None if the task does not define success."""
    success_rate: float | None
    """Fraction of rollouts that succeeded, None if the task does not define success."""
    sigma_mean: float
    """Mean of sigma after the update."""
    sigma_min: float
    """Least sigma."""
    sigma_max: float
    """Largest sigma."""
    mean_norm: float
    """Euclidean norm of mu after the update."""
    ended: int
    """Rollouts that the task ended before their last step."""
    failed: int
    """Rollouts whose simulation became unstable."""
    clamped: int
    """Rollouts whose return overflowed and was clamped."""
    reissued: int
    """Jobs reissued since the run's start (lost workers, stragglers, idle workers)."""
    workers: int
    """Number of workers at the end of the generation."""
    seconds: float
    """Wall time of the run so far, including the time before it was resumed [s]."""

    def to_dict(self) -> dict[str, Any]:
        """As a record of progress.jsonl."""
        return {"version": VERSION, **vars(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "GenerationStats":
        """Make it from a record of progress.jsonl.

        Raises:
          ValueError: another version, or a field is missing or of another type.
        """
        version = values.get("version") if isinstance(values, dict) else None
        if type(version) is not int or version != VERSION:
            raise ValueError(f"not a line of progress.jsonl, version {VERSION}: {str(values)[:80]}")
        missing = [f.name for f in fields(cls) if f.name not in values]
        if missing:
            raise ValueError(f"progress line without {', '.join(missing)}")
        for f in fields(cls):
            if not isinstance(values[f.name], cast("type", f.type)):
                raise ValueError(f"progress line whose {f.name} is {str(values[f.name])[:40]!r}")
        return cls(**{f.name: values[f.name] for f in fields(cls)})
