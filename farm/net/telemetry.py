"""Messages from learners to observers: a run's state and its reports. Pure data like `farm.net.messages`."""

from dataclasses import dataclass, field
from typing import Any

from farm.arrays import AnyArray
from farm.net.codec import array
from farm.net.messages import check_counts
from farm.net.work import WireTrajectory


def _check_plain(values: Any) -> None:  # noqa: ANN401
    """Check that a table has only JSON's types: arrays compare element by element. Raises ValueError otherwise."""
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
    canary: str
    rollouts: int
    """Number of rollouts that it has returned."""
    rate: float
    """Rollouts per second over the last ten seconds."""
    seen: float
    """Time since its last message [s]."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Number of messages that it ignored, by kind."""

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
    """Number of ignored messages by kind."""
    workers: tuple[WorkerStatus, ...]

    def __post_init__(self) -> None:
        check_counts(self.ignored)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the learner's log."""

    level: str
    """Name of the level in the standard library."""
    text: str


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Traces of some of a generation's rollouts."""

    name: str
    """`best` and `worst` hold one rollout, `all` holds all."""
    values: AnyArray = array("<f4", 3)
    """(R, T, N)"""

    def __post_init__(self) -> None:
        if self.name not in ("best", "worst", "all"):
            raise ValueError(f"traces {self.name[:40]!r} of shape {self.values.shape}")
        if self.name != "all" and len(self.values) != 1:
            raise ValueError(f"traces {self.name!r} of {len(self.values)} rollouts")


@dataclass(frozen=True, kw_only=True)
class RunReport:
    """Report of a finished generation, learner to recorders."""

    run: str
    incarnation: str
    generation: int
    progress: dict[str, Any]
    """Its line of progress.jsonl."""
    rate: float
    """Exploring rollouts per second."""
    lines: tuple[Line, ...] = ()
    """Lines of the log since the previous report."""
    traces: tuple[Trace, ...] = ()
    sample: WireTrajectory | None = None
    """The mean policy's rollout at control rate."""
    replay: WireTrajectory | None = None
    """The best rollout so far at physics rate, if there is a new one."""
    replay_generation: int = 0
    """The generation of the best rollout."""

    def __post_init__(self) -> None:
        _check_plain(self.progress)


@dataclass(frozen=True, kw_only=True)
class RunEnd:
    """The last report of a run."""

    summary: dict[str, Any]
    """As in summary.json."""
    lines: tuple[Line, ...]
    """Lines of the log since the previous report."""
    best: WireTrajectory | None
    """The best rollout of the run at physics rate."""
    best_generation: int
    """The generation of the best rollout."""
    mean: WireTrajectory | None
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
    """As in config.json."""
    files: dict[str, str]
    """Files of its task by name."""
    generation: int
    """Number of finished generations; if the last report is of an earlier one, query again from there."""
    reports: tuple[RunReport, ...]
    """In order; older ones have no rollouts and traces."""
    end: RunEnd | None

    def __post_init__(self) -> None:
        _check_plain(self.config)
        _check_plain(self.files)
