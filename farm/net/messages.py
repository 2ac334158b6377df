"""Who takes part and what is simulated, as learner and workers tell each other. Pure; bytes by `farm.net.codec`.

Everything on the wire is soft state: any message may be lost, doubled or late. Whatever belongs to work
(`farm.net.work`) carries (run, incarnation, round): the run's name, which start of its learner, which batch of jobs.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

_SHORT: Final = 250  # characters; names have up to 100, a worker's is two of them
_KINDS: Final = 20  # of messages that a worker ignores
_RUNS: Final = 1000  # that a worker serves


def check_counts(ignored: dict[str, int]) -> None:
    """See that messages which did not count are a few numbers by kind; else a ValueError."""
    kinds = len(ignored) <= _KINDS and all(type(kind) is str for kind in ignored)
    if not kinds or any(len(kind) > _SHORT or type(n) is not int for kind, n in ignored.items()):
        raise ValueError("ignored messages that are not a few numbers by kind")


@dataclass(frozen=True, kw_only=True)
class WorkRequest:
    """A worker's credits, worker to learners."""

    worker: str
    """<name>/<instance>"""
    credits: int
    """Jobs of one run it is willing to hold at a time."""
    idle: tuple[str, ...]
    """Runs that it holds nothing of, and has not for a while: what their learners believe it holds is lost."""
    version: str
    """Release of the worker's software."""
    canary: str
    """Digest of the numbers its machine gives; empty for a device, whose numbers are not to be had again."""
    host: str
    cores: int
    """That its machine has."""
    ignored: dict[str, int] = field(default_factory=dict)
    """Messages that did not count, by kind."""

    def __post_init__(self) -> None:
        """Check the number, and that what is remembered of a worker is short."""
        for said in (self.worker, self.version, self.canary, self.host):
            if len(said) > _SHORT or not said.isprintable():
                raise ValueError(f"a name of more than {_SHORT} characters, or unprintable ones")
        if len(self.idle) > _RUNS:
            raise ValueError(f"{len(self.idle)} runs")
        check_counts(self.ignored)
        if not 0 <= self.credits <= 100_000:
            raise ValueError(f"{self.credits} credits")


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What a run simulates; sent once, kept by workers under its digest. It names code, it never carries any."""

    run: str
    task: str
    """A name, NAME:VARIANT, or FILE.py:CLASS."""
    task_config: dict[str, Any]
    policy: str
    """A name, or FILE.py:CLASS."""
    policy_config: dict[str, Any]
    code: dict[str, str]
    """Digests of the code of `task`, `policy` and `simulation`."""
    release: str = ""
    """Package and version of the task's class, empty for the farm's own and for files."""
    policy_release: str = ""
    """The same for the policy's."""
    task_release: str = ""
    """Of what the task itself is made with, as its TaskSpec says."""
    files: dict[str, str] = field(default_factory=dict)
    """Texts that the task is made of, by name: models, objects."""
    constants: dict[str, Any] = field(default_factory=dict)
    """Arrays that the policy is made of, by name."""

    def __post_init__(self) -> None:
        """Check the tables that hold more than settings."""
        for table in (self.code, self.files):
            if any(type(name) is not str or type(text) is not str for name, text in table.items()):
                raise ValueError("a text that is none")
        for name, values in self.constants.items():
            if not isinstance(values, np.ndarray) or values.dtype != np.dtype("<f8") or not np.isfinite(values).all():
                raise ValueError(f"constant {str(name)[:40]!r} that is no array of finite float64")


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a run gives a worker no jobs, learner to worker."""

    run: str
    reason: str
