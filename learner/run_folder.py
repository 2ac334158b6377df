"""A run's folder: its files, and writing them so that nothing is lost.

    config.json      the resolved configuration
    checkpoint       everything a resume needs, replaced after every generation
    progress.jsonl   one line per generation
    parameters       mu and sigma of every generation
    summary.json     the results
    run.rrd          the recording;  replay.rrd  the best and the final rollout at physics rate
    log.txt          the messages

docs/files.md describes them. The checkpoint is written last. When the run is resumed, newer entries of the other
files are removed, damaged lines of progress.jsonl are dropped, and a copy of the damaged file is kept.
"""

import fcntl
import itertools
import json
import logging
import math
import os
import shutil
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import CheckpointError, ConfigError, NameTakenError
from farm.net.stats import GenerationStats
from learner import checkpoint as checkpoints
from learner import config as configs
from learner.checkpoint import Checkpoint
from learner.config import RunConfig

log = logging.getLogger(__name__)

PARAMETERS_LIMIT: Final = 100_000_000
"""Size from which `parameters` keeps only every k-th generation [bytes]."""

_PARAMETERS_VERSION: Final = 1
_NUMBER: Final = (float, int, type(None))
_SUMMARY: Final = {
    **dict.fromkeys(("run", "state", "parameters_sha256"), (str, type(None))),
    **dict.fromkeys(("seed", "generations", "rollouts"), (int,)),
    **dict.fromkeys(("seconds", "mean_policy_return", "robust_success_rate", "robust_return"), _NUMBER),
    "mean_policy_success": (bool, type(None)),
}
"""Types of the displayed values of a summary."""
_ASIDE: Final = "moved elsewhere, it keeps no run from going on"
_NONE: Final = np.empty((2, 0))  # the normaliser if observations are not normalised


@dataclass(frozen=True)
class RunFolder:
    """The files of one run."""

    path: Path

    @property
    def name(self) -> str:
        """The run's name."""
        return self.path.resolve().name

    @property
    def recording(self) -> Path:
        """The Rerun recording."""
        return self.path / "run.rrd"

    @property
    def checkpoint(self) -> Path:
        """The checkpoint."""
        return self.path / "checkpoint"

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> "RunFolder":
        """Make a new folder with its configuration.

        Raises:
          ConfigError: it exists, or cannot be made.
        """
        try:
            path.mkdir(parents=True)
        except OSError as error:
            if os.path.isdir(path):  # noqa: PTH112  never raises
                raise NameTakenError(
                    f"run folder {path} exists and is never overwritten: choose a different --name, or --resume {path}"
                ) from None
            raise ConfigError(f"cannot make the run folder {path}: {_in_the_way(path) or error.strerror}") from None
        folder = cls(path)
        try:
            folder.write_config(config)
        except OSError as error:
            folder.discard()
            raise ConfigError(f"cannot write to the run folder {path}: {error.strerror}") from None
        return folder

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open an existing run's folder; a ConfigError if there is none."""
        if not (path / "config.json").is_file():
            raise ConfigError(f"{path} is not a run's folder: it has no config.json")
        return cls(path)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the run until this process ends; a ConfigError if another process has locked it."""
        folder = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(
                    f"another process is working on the run in {self.path}: wait until it has ended"
                ) from None
            yield
        finally:
            os.close(folder)

    def discard(self) -> None:
        """Remove a new run that could not start."""
        shutil.rmtree(self.path)

    def write_config(self, config: RunConfig) -> None:
        """Write config.json."""
        replace_text(self.path / "config.json", json.dumps(configs.to_dict(config), indent=2) + "\n")

    def read_config(self) -> RunConfig:
        """Read config.json."""
        return configs.read(self.path / "config.json")

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        replace_text(self.path / "summary.json", json.dumps(summary, indent=2) + "\n")

    def read_summary(self) -> dict[str, Any] | None:
        """Read summary.json; None if there is no readable one."""
        try:
            summary = json.loads((self.path / "summary.json").read_text("utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        return summary if isinstance(summary, dict) and _makes_sense(summary) else None

    def append(
        self,
        progress: GenerationStats,
        mu: FloatArray,
        sigma: FloatArray,
        generations: int,
        normaliser: FloatArray = _NONE,
    ) -> None:
        """Add a generation to progress.jsonl and parameters: mu and sigma (P,), and a normaliser (2, d)."""
        with (self.path / "progress.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(progress.to_dict()) + "\n")
        path = self.path / "parameters"
        if not path.exists():
            replace_text(path, _parameters_head(len(mu), generations, normaliser.shape[1]))
        head, _ = _read_head(path)
        if progress.generation % head["every"] == 0:
            numbers = np.empty(1, _row_type(len(mu), normaliser.shape[1]))
            numbers["generation"], numbers["mu"], numbers["sigma"] = progress.generation, mu, sigma
            if normaliser.size:
                numbers["normaliser"] = normaliser
            with path.open("ab") as binary:
                binary.write(numbers.tobytes())

    def progress(self) -> list[GenerationStats]:
        """Every readable line of progress.jsonl, in order of generations."""
        try:
            return [stats for _, stats in self._lines()[0]]
        except OSError:
            return []

    def _lines(self) -> tuple[list[tuple[int, GenerationStats]], list[int], bool]:
        """Readable lines of progress.jsonl by number; numbers of unreadable ones; whether the last one is incomplete.

        A damaged line never affects other lines, neither by its contents nor by its generation.
        """
        *lines, end = (self.path / "progress.jsonl").read_text("utf-8", "replace").split("\n")
        read = []
        for number, line in enumerate([*lines, end], 1):
            with suppress(ValueError, RecursionError):
                read.append((number, GenerationStats.from_dict(json.loads(line))))
        read = [read[i] for i in _rising([stats.generation for _, stats in read])]
        known = {number for number, _ in read}
        lost = [number for number in range(1, len(lines) + 1) if number not in known]
        return read, lost, bool(end) and len(lines) + 1 not in known

    def every(self, parameters: int, generations: int, observation: int = 0) -> int:
        """Interval of the generations kept in `parameters`, or of a new run's."""
        path = self.path / "parameters"
        return int(_read_head(path)[0]["every"]) if path.exists() else every(parameters, generations, observation)

    def parameters(self) -> "np.ndarray[Any, Any]":
        """Rows of `parameters`: generation, mu (P,), sigma (P,) and, for a run that normalises, normaliser (2, d).

        Raises:
          ConfigError: the file is missing or of another version.
        """
        path = self.path / "parameters"
        head, offset = _read_head(path)
        body = path.read_bytes()[offset:]
        kind = _row_type(head["parameters"], head.get("observation", 0))
        rows = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)
        kept = rows["generation"]
        if (kept[:1] <= 0).any() or (kept % head["every"]).any() or (np.diff(kept) != head["every"]).any():
            raise ConfigError(f"{path} is damaged: its generations do not rise as its first line says; {_ASIDE}")
        return rows

    def mean(self, generation: int) -> tuple[FloatArray, FloatArray]:
        """The mean mu after a generation, (P,), and the normaliser of its observations, (2, d) or (2, 0).

        Raises:
          ConfigError: it is not in `parameters`; names the generations that are.
        """
        rows = self.parameters()
        kept = rows["generation"]
        found = np.flatnonzero(kept == generation)
        if not len(found):
            raise ConfigError(f"generation {generation} is not stored in {self.path}: {_offer(kept, generation)}")
        row = rows[found[0]]
        return row["mu"], row["normaliser"] if "normaliser" in row.dtype.names else _NONE

    def average(self, generation: int, mu: FloatArray, count: int) -> FloatArray:
        """The average of mu, the mean after a generation, and the stored ones among the `count` - 1 before it, (P,)."""
        first = max(1, generation - count + 1)
        if first >= generation:
            return mu
        step = self.every(mu.size, generation)
        wanted = [each for each in range(first, generation) if each % step == 0]
        rows = self.parameters() if (self.path / "parameters").exists() else np.empty(0, _row_type(mu.size, 0))
        before = rows[np.isin(rows["generation"], wanted)]
        if len(before) < len(wanted):
            log.warning(
                "%s lacks means of generations %d to %d: the average is of %d instead of %d",
                self.path / "parameters", first, generation - 1, len(before) + 1, len(wanted) + 1,
            )  # fmt: skip
        return np.asarray(np.mean([*before["mu"], mu], axis=0))

    def save(self, checkpoint: Checkpoint, *, durable: bool = True) -> None:
        """Replace the checkpoint; durable: also safe against a power failure."""
        if durable:  # first the files that it relies on
            for name in ("config.json", "progress.jsonl", "parameters"):
                with suppress(FileNotFoundError):
                    checkpoints.flush(self.path / name)
        checkpoints.save(self.checkpoint, checkpoint, durable=durable)

    def settle(self) -> None:
        """Flush the checkpoint to the disk, and delete its copy."""
        checkpoints.settle(self.checkpoint)

    def rewind(self, checkpoint: Checkpoint) -> None:
        """Remove entries of the other files that are newer than the checkpoint.

        Raises:
          CheckpointError: it cannot be used.
        """
        generation = checkpoint.state.get("generation")
        if type(generation) is not int:
            raise CheckpointError(f"{self.checkpoint} holds no generation")
        size = np.asarray(checkpoint.state.get("mu")).size
        whole = self._parameters_until(generation, size)  # raises if unusable
        self._rewind_progress(generation)
        if whole is not None:
            with (self.path / "parameters").open("r+b") as file:
                file.truncate(whole)

    def _parameters_until(self, generation: int, size: int) -> int | None:
        """Size of `parameters` up to a generation [bytes]; None if there are none."""
        path = self.path / "parameters"
        if not path.exists():
            return None
        rows, (head, offset) = self.parameters(), _read_head(path)
        if head["parameters"] != size:
            raise CheckpointError(f"{path} is of {head['parameters']} parameters, the checkpoint of {size}: {_ASIDE}")
        if not len(rows) and generation >= head["every"] and path.stat().st_size > offset:
            raise CheckpointError(f"{path} is damaged: it holds no row as its first line describes them; {_ASIDE}")
        kept = rows["generation"][rows["generation"] <= generation]
        if len(kept) and kept[-1] + head["every"] <= generation:
            raise CheckpointError(
                f"{path} ends with generation {kept[-1]}, the checkpoint is of {generation}; if there is a "
                f"{self.checkpoint.name}.safe, put it in the checkpoint's place, or move {path.name} elsewhere"
            )
        return offset + len(kept) * rows.itemsize

    def _rewind_progress(self, generation: int) -> None:
        path = self.path / "progress.jsonl"
        try:
            read, lost, torn = self._lines()
        except FileNotFoundError:
            read, lost, torn = [], [], False
        kept = [stats for _, stats in read if stats.generation <= generation]
        if torn and (not read or read[-1][1].generation < generation):
            lost.append(path.read_bytes().count(b"\n") + 1)  # otherwise it is of a later generation
        if lost:
            copy = _copy(path)
            which = ", ".join(map(str, lost[:10])) + (", ..." if len(lost) > 10 else "")
            log.warning(
                "%s: %d damaged line(s) dropped (line %s), %d kept; all of it is in %s",
                path, len(lost), which, len(kept), copy,
            )  # fmt: skip
        replace_text(path, "".join(json.dumps(stats.to_dict()) + "\n" for stats in kept))


def every(parameters: int, generations: int, observation: int = 0) -> int:
    """Interval of the generations to keep, so that the file stays below PARAMETERS_LIMIT."""
    size = _row_type(parameters, observation).itemsize * max(generations, 1)
    return max(1, math.ceil(size / PARAMETERS_LIMIT))


def _in_the_way(path: Path) -> str:
    """What blocks the path of a folder or of one above it; empty if nothing does."""
    for part in (*reversed(path.parents), path):
        if part.is_symlink() and not os.path.isdir(part):  # noqa: PTH112
            return f"{part} is a link to {part.readlink()}, which is no folder"
        if os.path.isfile(part):  # noqa: PTH113
            return f"{part} is a file: Not a directory"
    return ""


def _makes_sense(summary: dict[str, Any]) -> bool:
    """Whether the shown values of a summary have the right types."""
    known = [(summary[name], kinds) for name, kinds in _SUMMARY.items() if name in summary]
    return all(type(value) in kinds and (type(value) is not int or abs(value) < 2**63) for value, kinds in known)


def _rising(numbers: list[int]) -> list[int]:
    """Positions of a longest ascending subsequence, so that a wrong number does not discard the others."""
    ends: list[int] = []  # of the subsequences of each length, the one that ends lowest
    before: list[int | None] = []
    for i, number in enumerate(numbers):
        length = bisect_left(ends, number, key=numbers.__getitem__)
        before.append(ends[length - 1] if length else None)
        ends[length : length + 1] = [i]
    found, at = [], ends[-1] if ends else None
    while at is not None:
        found.append(at)
        at = before[at]
    return found[::-1]


def _copy(path: Path) -> Path:
    """Copy a damaged file next to it; older copies are kept."""
    copies = (path.with_name(f"{path.name}.damaged{n if n > 1 else ''}") for n in itertools.count(1))
    copy = next(each for each in copies if not os.path.lexists(each))
    try:
        shutil.copyfile(path, copy)
    except OSError:
        copy.unlink(missing_ok=True)
        raise
    return copy


def _offer(kept: IntArray, wanted: int) -> str:
    """The available generations, for an error."""
    if not len(kept):
        return "none is"
    nearest = kept[np.abs(kept - wanted).argmin()]
    return f"{len(kept)} from {kept[0]} to {kept[-1]} are, the nearest is {nearest}"


def _row_type(parameters: int, observation: int) -> "np.dtype[Any]":
    own: list[Any] = [("normaliser", "<f8", (2, observation))] if observation else []
    return np.dtype([("generation", "<i8"), ("mu", "<f8", (parameters,)), ("sigma", "<f8", (parameters,)), *own])


def _parameters_head(parameters: int, generations: int, observation: int) -> str:
    head: dict[str, Any] = {
        "version": _PARAMETERS_VERSION,
        "parameters": parameters,
        "every": every(parameters, generations, observation),
        "row": "<i8 generation, <f8[parameters] mu, <f8[parameters] sigma",
    }
    if observation:
        head |= {"observation": observation, "row": head["row"] + ", <f8[2, observation] normaliser"}
    return json.dumps(head) + "\n"


def _read_head(path: Path) -> tuple[dict[str, Any], int]:
    try:
        with path.open("rb") as file:
            line = file.readline(1000)
        head = json.loads(line)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise ConfigError(f"{path} has no readable first line") from None
    if not isinstance(head, dict) or head.get("version") != _PARAMETERS_VERSION:
        raise ConfigError(f"{path} is not of version {_PARAMETERS_VERSION}")
    for name, least in (("parameters", 1), ("every", 1), ("observation", 0)):
        count = head.get(name, 0)
        if type(count) is not int or not least <= count < PARAMETERS_LIMIT:
            raise ConfigError(f"{path} is damaged: its first line says {str(count)[:20]} for {name}; {_ASIDE}")
    return head, len(line)


def replace_text(path: Path, text: str) -> None:
    """Write a whole file, or (an OSError) leave the old one."""
    checkpoints.replace(path, text.encode())
