"""Messages about workers and about the run's specification. Pure data, encoded by `farm.net.codec`.

All messages are soft state: any of them may be lost, duplicated or late. Messages about work
(`farm.net.work`) carry (run, incarnation, round): the run's name, an id of its learner's start, and
the number of the batch of jobs.
"""

import re
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

_SHORT: Final = 250  # characters; names have up to 100, a worker's has two of them
_KINDS: Final = 20  # kinds of ignored messages
_RUNS: Final = 1000  # runs that a worker serves
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")


def check_counts(ignored: dict[str, int]) -> None:
    """Check that the counts of ignored messages are a few numbers by kind.

    Raises ValueError otherwise.
    """
    kinds = len(ignored) <= _KINDS and all(type(kind) is str for kind in ignored)
    if not kinds or any(len(kind) > _SHORT or type(n) is not int for kind, n in ignored.items()):
        raise ValueError("ignored messages that are not a few numbers by kind")


def check_assets(assets: dict[str, str]) -> None:
    """Check that files by path are SHA-256 in hexadecimal digits; raises ValueError otherwise."""
    for name, digest in assets.items():
        if type(name) is not str or type(digest) is not str or not _DIGEST.fullmatch(digest):
            raise ValueError(f"a file {str(name)[:40]!r} without a SHA-256")


@dataclass(frozen=True, kw_only=True)
class WorkRequest:
    """A worker's request for jobs, worker to learners."""

    worker: str
    """<name>/<instance>"""
    credits: int
    """Number of jobs of one run that it accepts at a time."""
    idle: tuple[str, ...]
    """Runs of which it has had no jobs for a while: jobs that their learners believe it has are
    lost.
    """
    version: str
    """Release of the worker's software."""
    fingerprint: str
    """Fingerprint of its machine's numbers; empty for a device, whose results are not
    reproducible.
    """
    host: str
    cores: int
    ignored: dict[str, int] = field(default_factory=dict)
    """Number of ignored messages by kind."""

    def __post_init__(self) -> None:
        for text in (self.worker, self.version, self.fingerprint, self.host):
            if len(text) > _SHORT or not text.isprintable():
                raise ValueError(f"a name of more than {_SHORT} characters, or unprintable ones")
        if len(self.idle) > _RUNS:
            raise ValueError(f"{len(self.idle)} runs")
        check_counts(self.ignored)
        if not 0 <= self.credits <= 100_000:
            raise ValueError(f"{self.credits} credits")


@dataclass(frozen=True, kw_only=True)
class Spec:
    """Specification of what a run simulates; sent once, kept by workers under its digest.

    It names code but never contains any.
    """

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
    """Package and version of the policy's class, empty for the farm's own and for files."""
    task_release: str = ""
    """Release of the package that simulates the task, as in its TaskSpec."""
    files: dict[str, str] = field(default_factory=dict)
    """Texts of the task by path: models, objects."""
    assets: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the other files of the task by path: meshes, textures."""
    constants: dict[str, Any] = field(default_factory=dict)
    """Constant arrays of the policy by name."""

    def __post_init__(self) -> None:
        for table in (self.code, self.files):
            if any(type(name) is not str or type(text) is not str for name, text in table.items()):
                raise ValueError("a text that is not a string")
        check_assets(self.assets)
        for name, values in self.constants.items():
            if (
                not isinstance(values, np.ndarray)
                or values.dtype != np.dtype("<f8")
                or not np.isfinite(values).all()
            ):
                raise ValueError(
                    f"constant {str(name)[:40]!r} that is not an array of finite float64"
                )


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """The reason why a run gives a worker no jobs, learner to worker."""

    run: str
    reason: str
