"""What learners tell observers: how a run is doing, and what was recorded of it. Pure, as `farm.net.messages`."""

from dataclasses import dataclass, field
from typing import Any

from farm.arrays import AnyArray
from farm.net.codec import array
from farm.net.messages import check_counts
from farm.net.work import WireTrajectory


def _check_plain(values: Any) -> None:  # noqa: ANN401
    """See that a table is as JSON has it: an array in it would be compared element by element. Else a ValueError."""
    for name, value in values.items() if type(values) is dict else enumerate(values):
        if type(values) is dict and type(name) is not str:
            raise ValueError(f"a name that is a {type(name).__name__}")
        if type(value) in (dict, list, tuple):
            _check_plain(value)
        elif not isinstance(value, str | int | float | None):
            raise ValueError(f"a {type(value).__name__} where JSON has none")


@dataclass(frozen=True, kw_only=True)
class WorkerStatus:
    """How a worker is doing, as a learner sees it."""

    worker: str
    host: str
    cores: int
    version: str
    canary: str
    rollouts: int
    """It has brought so many."""
    rate: float
    """Rollouts a second, over the last ten."""
    seen: float
    """Since it was last heard of [s]."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Messages that it ignored, by kind."""

    def __post_init__(self) -> None:
        """Check the counts."""
        check_counts(self.ignored)


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """How a run is doing, answered by its learner."""

    run: str
    generation: int
    generations: int
    return_mean: float | None
    mean_policy_return: float | None
    open: int
    """Jobs of this round that are not done."""
    reissued: int
    refused: int
    """Workers that were refused."""
    ignored: dict[str, int]
    """Messages that did not count, by kind."""
    workers: tuple[WorkerStatus, ...]

    def __post_init__(self) -> None:
        """Check the counts."""
        check_counts(self.ignored)


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the learner's log."""

    level: str
    """A name of the standard library's."""
    text: str


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Traces of some of a generation's rollouts."""

    name: str
    """`best` and `worst` are of one rollout, `all` of all."""
    values: AnyArray = array("<f4", 3)
    """(R, T, N)"""

    def __post_init__(self) -> None:
        """Check name and shape."""
        if self.name not in ("best", "worst", "all"):
            raise ValueError(f"traces {self.name[:40]!r} of shape {self.values.shape}")
        if self.name != "all" and len(self.values) != 1:
            raise ValueError(f"traces {self.name!r} of {len(self.values)} rollouts")


@dataclass(frozen=True, kw_only=True)
class RunReport:
    """A generation that is over, learner to recorders."""

    run: str
    incarnation: str
    generation: int
    progress: dict[str, Any]
    """Its line of progress.jsonl."""
    rate: float
    """Exploring rollouts a second."""
    lines: tuple[Line, ...] = ()
    """Of the log, since the report before."""
    traces: tuple[Trace, ...] = ()
    sample: WireTrajectory | None = None
    """The mean policy's rollout at control rate."""
    replay: WireTrajectory | None = None
    """The best rollout so far at physics rate, once there is a new one."""
    replay_generation: int = 0
    """The generation that one came from."""

    def __post_init__(self) -> None:
        """Check the table."""
        _check_plain(self.progress)


@dataclass(frozen=True, kw_only=True)
class RunEnd:
    """A run that is over for good: nothing more will be reported."""

    summary: dict[str, Any]
    """As in summary.json."""
    lines: tuple[Line, ...]
    """Of the log, since the last report."""
    best: WireTrajectory | None
    """The best rollout of the run at physics rate."""
    best_generation: int
    """The generation it came from."""
    mean: WireTrajectory | None
    """The final mean policy's rollout at physics rate; None where the run diverged."""

    def __post_init__(self) -> None:
        """Check the table."""
        _check_plain(self.summary)


@dataclass(frozen=True, kw_only=True)
class RunHistory:
    """What a run is, and what it reported from a generation on: a page of it."""

    run: str
    incarnation: str
    recording: str
    """Name that the run began with, the id of its recording."""
    config: dict[str, Any]
    """As in config.json."""
    files: dict[str, str]
    """Texts that its task is made of."""
    generation: int
    """Generations that are over; where the last report is an earlier one, ask on from there."""
    reports: tuple[RunReport, ...]
    """In order; older ones without rollouts and traces."""
    end: RunEnd | None

    def __post_init__(self) -> None:
        """Check the tables."""
        _check_plain(self.config)
        _check_plain(self.files)
