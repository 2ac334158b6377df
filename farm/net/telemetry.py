"""Messages from learners to observers: a run's state and its reports.

Pure data like `farm.net.messages`.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from farm.net.messages import check_assets, check_counts
from farm.net.stats import GenerationStats
from farm.sim.trajectory import Trajectory

STATISTICS: Final = 600
"""Size of a report without rollouts, traces and lines [bytes], approximately."""


def _check_plain(values: Any) -> None:  # noqa: ANN401
    """Check that a table has only JSON's types: arrays compare element by element.

    Raises ValueError otherwise.
    """
    for name, value in values.items() if type(values) is dict else enumerate(values):
        if type(values) is dict and type(name) is not str:
            raise ValueError(f"a name that is a {type(name).__name__}")
        if type(value) in (dict, list, tuple):
            _check_plain(value)
        elif not isinstance(value, str | int | float | None):
            raise ValueError(f"a {type(value).__name__} in a JSON table")


@dataclass(frozen=True, kw_only=True)
class WorkerStatus:
    """A worker's state as seen by a learner."""

    worker: str
    host: str
    cores: int
    version: str
    fingerprint: str
    rollouts: int
    rate: float
    """Rollouts per second over the last ten seconds."""
    seen: float
    """Time since its last message [s]."""
    ignored: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_counts(self.ignored)


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """A run's state, sent by its learner on request."""

    run: str
    generation: int
    generations: int
    return_mean: float | None
    mean_policy_return: float | None
    open: int
    """Unfinished jobs of this round."""
    reissued: int
    refused: int
    """Refused workers with the reasons."""
    ignored: dict[str, int]
    workers: tuple[WorkerStatus, ...]
    fingerprint: str = ""
    """Fingerprint of the machines whose numbers the run accepts, or how it begins."""

    def __post_init__(self) -> None:
        check_counts(self.ignored)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the learner's log."""

    level: str
    """Name of the level in the standard library."""
    text: str


@dataclass(frozen=True, kw_only=True)
class Report:
    """A finished generation, learner to displays, recordings and recorders elsewhere."""

    progress: GenerationStats
    """The generation's line of progress.jsonl."""
    rate: float
    """Exploring rollouts per second in this generation."""
    traces: dict[str, Any] = field(default_factory=dict)
    """Traces, float32: `best` and `worst` (T, N), and `all` (S, T, N) if the run keeps them."""
    sample: Trajectory | None = None
    """The mean policy's rollout at control rate."""
    replay: Trajectory | None = None
    """The best rollout so far at physics rate, if there is a new one."""
    replay_generation: int = 0
    incarnation: str = ""
    """Incarnation of the learner; empty until the report is sent, as are the lines."""
    lines: tuple[Line, ...] = ()
    """Lines of the log since the previous report."""

    def __post_init__(self) -> None:
        for name, values in self.traces.items():
            if name not in ("best", "worst", "all") or getattr(values, "dtype", None) != np.dtype(
                "<f4"
            ):
                raise ValueError(f"traces {str(name)[:40]!r}, or not of float32")
            if values.ndim != 2 + (name == "all"):
                raise ValueError(f"traces {name!r} of shape {values.shape}")

    @property
    def generation(self) -> int:
        """Number of the generation."""
        return self.progress.generation

    @property
    def nbytes(self) -> int:
        """Size [bytes]: of rollouts and traces, and about that of the rest."""
        parts = (self.sample, self.replay, *self.traces.values())
        return STATISTICS + sum(each.nbytes for each in parts if each is not None)


@dataclass(frozen=True, kw_only=True)
class RunEnd:
    """The last report of a run."""

    summary: dict[str, Any]
    """Contents of summary.json."""
    lines: tuple[Line, ...] = ()
    """Lines of the log since the previous report; without any until it is sent."""
    best: Trajectory | None
    """The best rollout of the run at physics rate."""
    best_generation: int
    mean: Trajectory | None
    """The final mean policy's rollout at physics rate; None where the run diverged."""

    def __post_init__(self) -> None:
        _check_plain(self.summary)


@dataclass(frozen=True, kw_only=True)
class RunHistory:
    """A run's description, and one page of its reports from a given generation on."""

    run: str
    incarnation: str
    recording: str
    """The run's original name, the id of its recording."""
    config: dict[str, Any]
    """Contents of config.json."""
    files: dict[str, str]
    """Texts of its task by path."""
    generation: int
    """Number of finished generations.

    If the last report is of an earlier one, query again from there.
    """
    reports: tuple[Report, ...]
    """Reports in order; older ones have no rollouts and traces."""
    end: RunEnd | None
    assets: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the other files of its task by path."""
    undone: int = 0
    """Generations that were repeated because a host in them was expelled."""

    def __post_init__(self) -> None:
        _check_plain(self.config)
        _check_plain(self.files)
        check_assets(self.assets)
