"""Who takes part and what is simulated, as learner and workers tell each other. Pure; bytes by `farm.net.codec`.

Everything on the wire is soft state: any message may be lost, doubled or late. Whatever belongs to work (`farm.net.jobs`,
`farm.net.results`) carries (run, incarnation, round): the run's name, which start of its learner, which batch of jobs.
"""

from dataclasses import dataclass, field
from typing import Any, Final

from farm.arrays import FloatArray
from farm.net.codec import array

_SHORT: Final = 250  # characters; names have up to 100, a worker's is two of them
_KINDS: Final = 20  # of messages that a worker ignores
_RUNS: Final = 1000  # that a worker serves


@dataclass(frozen=True, kw_only=True)
class Want:
    """A worker's credits, worker to learners."""

    worker: str
    """<name>/<instance>"""
    credits: int
    """Jobs of one run it is willing to hold at a time."""
    idle: tuple[str, ...]
    """Runs that it holds nothing of, and has not for a while: what their learners believe it holds is lost."""
    version: str
    """Release of the worker's software."""
    assets: str
    """Digest of its hand and objects."""
    canary: str
    """Digest of the numbers its machine gives."""
    host: str
    cores: int
    """That its machine has."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Messages that did not count, by kind."""

    def __post_init__(self) -> None:
        """Check the number, and that what is remembered of a worker is short."""
        for said in (self.worker, self.version, self.assets, self.canary, self.host):
            if len(said) > _SHORT or not said.isprintable():
                raise ValueError(f"a name of more than {_SHORT} characters, or unprintable ones")
        if len(self.idle) > _RUNS:
            raise ValueError(f"{len(self.idle)} runs")
        kinds = len(self.ignored) <= _KINDS and all(type(kind) is str for kind in self.ignored)
        if not kinds or any(len(kind) > _SHORT or type(n) is not int for kind, n in self.ignored.items()):
            raise ValueError("ignored messages that are not a few numbers by kind")
        if not 0 <= self.credits <= 100_000:
            raise ValueError(f"{self.credits} credits")


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What a run simulates; told once, kept by workers under its digest. It names things, it never carries code."""

    run: str
    task: str
    """finger-gait, or gym:NAME."""
    task_config: dict[str, Any]
    policy_config: dict[str, Any]
    release: str = ""
    """Of the package that the task comes from, empty for the farm's own."""
    frequencies: FloatArray = array("<f8", 2)
    """Random features W, (D, d)"""
    phases: FloatArray = array("<f8", 1)
    """Random features c, (D,)"""


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a run gives a worker no jobs, learner to worker."""

    run: str
    reason: str
