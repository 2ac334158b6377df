"""Two of the three files of a run that grow by one entry per generation; `hash_chain.py` has the
third.

Each keeps working if a part of it is damaged.
"""

import itertools
import json
import logging
import math
import os
import shutil
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import CheckpointError, ConfigError
from farm.net.stats import GenerationStats
from learner.run import checkpoint as checkpoints

log = logging.getLogger(__name__)

PARAMETERS_LIMIT: Final = 100_000_000
"""Size from which `parameters` keeps only every k-th generation [bytes]."""

NONE: Final = np.empty((2, 0))
"""The normaliser if observations are not normalised."""

_VERSION: Final = 1  # of parameters
_END: Final = 64 << 10  # [bytes] of a file's end that are read to find its last line
_ASIDE: Final = "moved elsewhere, it keeps no run from going on"


@dataclass(frozen=True)
class ProgressFile:
    """progress.jsonl: the statistics of every generation, one line each."""

    path: Path

    def append(self, stats: GenerationStats) -> None:
        """Add a line."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(stats.to_dict()) + "\n")

    def read(self) -> list[GenerationStats]:
        """Every readable line, in order of generations."""
        try:
            return [stats for _, stats in self._lines()[0]]
        except OSError:
            return []

    def last(self) -> GenerationStats | None:
        """The last readable line, None if there is none; reads the end of the file only."""
        try:
            with self.path.open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - _END))
                lines = [_parsed(line) for line in file.read().splitlines()]
        except OSError:
            return None
        readable = [stats for stats in lines if stats is not None] or self.read()
        return readable[_rising([stats.generation for stats in readable])[-1]] if readable else None

    def after(self, generation: int) -> Iterator[GenerationStats]:
        """Lines of later generations in order, each read when it is taken; only they are read."""
        try:
            file = self.path.open("rb")
        except OSError:
            return
        with file:
            low, high = 0, file.seek(0, os.SEEK_END)
            # The line after `low` is of an earlier generation, or the first one
            while high - low > _END:
                middle = (low + high) // 2
                file.seek(middle)
                file.readline()
                stats = _parsed(file.readline())
                if stats is not None and stats.generation <= generation:
                    low = middle
                else:
                    high = middle
            file.seek(low)
            if low:
                file.readline()
            for stats in map(_parsed, file):
                if stats is not None and stats.generation > generation:
                    generation = stats.generation
                    yield stats

    def truncate(self, generation: int) -> None:
        """Remove what is newer than a generation, and damaged lines, of which a copy is kept."""
        path = self.path
        try:
            readable, damaged, torn = self._lines()
        except FileNotFoundError:
            readable, damaged, torn = [], [], False
        remaining = [stats for _, stats in readable if stats.generation <= generation]
        if torn and (not readable or readable[-1][1].generation < generation):
            # Otherwise it is of a later generation
            damaged.append(path.read_bytes().count(b"\n") + 1)
        if damaged:
            copy = _copy(path)
            which = ", ".join(map(str, damaged[:10])) + (", ..." if len(damaged) > 10 else "")
            log.warning(
                "%s: %d damaged line(s) dropped (line %s), %d kept; all of it is in %s",
                path,
                len(damaged),
                which,
                len(remaining),
                copy,
            )
        if damaged or torn or len(remaining) < len(readable) or not path.exists():
            replace_text(path, "".join(json.dumps(stats.to_dict()) + "\n" for stats in remaining))

    def _lines(self) -> tuple[list[tuple[int, GenerationStats]], list[int], bool]:
        """Readable lines by number; numbers of unreadable ones; whether the last one is incomplete.

        A damaged line never affects other lines, neither by its contents nor by its generation.
        """
        *lines, end = self.path.read_text("utf-8", "replace").split("\n")
        parsed = ((number, _parsed(line)) for number, line in enumerate([*lines, end], 1))
        readable = [(number, stats) for number, stats in parsed if stats is not None]
        readable = [readable[i] for i in _rising([stats.generation for _, stats in readable])]
        numbers = {number for number, _ in readable}
        damaged = [number for number in range(1, len(lines) + 1) if number not in numbers]
        return readable, damaged, bool(end) and len(lines) + 1 not in numbers


@dataclass(frozen=True)
class ParametersFile:
    """parameters: mu and sigma of every k-th generation, as rows of numbers after a first line that
    describes them.
    """

    path: Path

    def append(
        self,
        generation: int,
        mu: FloatArray,
        sigma: FloatArray,
        generations: int,
        normaliser: FloatArray = NONE,
    ) -> None:
        """Add a generation, if it is one of those that are kept: mu and sigma (P,), and a
        normaliser (2, d).
        """
        if not self.path.exists():
            replace_text(self.path, _head(len(mu), generations, normaliser.shape[1]))
        if generation % _read_head(self.path)[0]["every"] == 0:
            numbers = np.empty(1, _row_type(len(mu), normaliser.shape[1]))
            numbers["generation"], numbers["mu"], numbers["sigma"] = generation, mu, sigma
            if normaliser.size:
                numbers["normaliser"] = normaliser
            with self.path.open("ab") as binary:
                binary.write(numbers.tobytes())

    def every(self, parameters: int, generations: int, observation: int = 0) -> int:
        """Interval of the generations that are kept, or will be."""
        if not self.path.exists():
            return every(parameters, generations, observation)
        return int(_read_head(self.path)[0]["every"])

    def rows(self) -> "np.ndarray[Any, Any]":
        """All rows: generation, mu (P,), sigma (P,) and, for a run that normalises, normaliser (2,
        d).

        Raises:
          ConfigError: the file is missing or of another version.
        """
        head, offset = _read_head(self.path)
        body = self.path.read_bytes()[offset:]
        kind = _row_type(head["parameters"], head.get("observation", 0))
        rows = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)
        generations = rows["generation"]
        if (
            (generations[:1] <= 0).any()
            or (generations % head["every"]).any()
            or (np.diff(generations) != head["every"]).any()
        ):
            raise ConfigError(
                f"{self.path} is damaged: its generations do not rise as its first line says;"
                f" {_ASIDE}"
            )
        return rows

    def mean(self, generation: int) -> tuple[FloatArray, FloatArray]:
        """The mean mu after a generation, (P,), and the normaliser of its observations, (2, d) or
        (2, 0).

        Raises:
          ConfigError: it is not kept; names the generations that are.
        """
        rows = self.rows()
        generations = rows["generation"]
        matches = np.flatnonzero(generations == generation)
        if not len(matches):
            raise ConfigError(
                f"generation {generation} is not stored in {self.path.parent}:"
                f" {_offer(generations, generation)}"
            )
        row = rows[matches[0]]
        return row["mu"], row["normaliser"] if "normaliser" in row.dtype.names else NONE

    def average(self, generation: int, mu: FloatArray, count: int) -> FloatArray:
        """The average of mu, the mean after a generation, and the stored ones among the `count` - 1
        before it, (P,).
        """
        first = max(1, generation - count + 1)
        if first >= generation:
            return mu
        step = self.every(mu.size, generation)
        generations = [each for each in range(first, generation) if each % step == 0]
        rows = self.rows() if self.path.exists() else np.empty(0, _row_type(mu.size, 0))
        before = rows[np.isin(rows["generation"], generations)]
        if len(before) < len(generations):
            log.warning(
                "%s lacks means of generations %d to %d: the average is of %d instead of %d",
                self.path,
                first,
                generation - 1,
                len(before) + 1,
                len(generations) + 1,
            )
        return np.asarray(np.mean([*before["mu"], mu], axis=0))

    def until(self, generation: int, size: int, checkpoint: str) -> int | None:
        """Size of the file up to a generation [bytes]; None if there is no file.

        Args:
          generation: that of the checkpoint.
          size: its number of parameters.
          checkpoint: its file's name.

        Raises:
          CheckpointError: the file does not belong to the checkpoint.
        """
        path = self.path
        if not path.exists():
            return None
        rows, (head, offset) = self.rows(), _read_head(path)
        if head["parameters"] != size:
            raise CheckpointError(
                f"{path} is of {head['parameters']} parameters, the checkpoint of {size}: {_ASIDE}"
            )
        if not len(rows) and generation >= head["every"] and path.stat().st_size > offset:
            raise CheckpointError(
                f"{path} is damaged: it holds no row as its first line describes them; {_ASIDE}"
            )
        generations = rows["generation"][rows["generation"] <= generation]
        if len(generations) and generations[-1] + head["every"] <= generation:
            raise CheckpointError(
                f"{path} ends with generation {generations[-1]}, the checkpoint is of {generation};"
                f" if there is a {checkpoint}.safe, put it in the checkpoint's place, or move"
                f" {path.name} elsewhere"
            )
        return offset + len(generations) * rows.itemsize

    def truncate(self, size: int | None) -> None:
        """Cut the file at a size from `until`."""
        if size is not None:
            with self.path.open("r+b") as file:
                file.truncate(size)


def _parsed(line: str | bytes) -> GenerationStats | None:
    """A line of progress.jsonl; None if it is damaged."""
    try:
        return GenerationStats.from_dict(json.loads(line))
    except (ValueError, RecursionError):
        return None


def with_rates(progress: Iterable[GenerationStats]) -> Iterator[tuple[GenerationStats, float]]:
    """Successive generations, each with its exploring rollouts per second."""
    rollouts, seconds = 0, 0.0
    for stats in progress:
        # Written to the millisecond
        yield (stats, (stats.rollouts - rollouts) / max(stats.seconds - seconds, 1e-3))
        rollouts, seconds = stats.rollouts, stats.seconds


def every(parameters: int, generations: int, observation: int = 0) -> int:
    """Interval of the generations to keep, so that the file stays below PARAMETERS_LIMIT."""
    size = _row_type(parameters, observation).itemsize * max(generations, 1)
    return max(1, math.ceil(size / PARAMETERS_LIMIT))


def _rising(numbers: list[int]) -> list[int]:
    """Positions of a longest ascending subsequence, so that a wrong number does not discard the
    others.
    """
    ends: list[int] = []  # of the subsequences of each length, the one that ends lowest
    before: list[int | None] = []
    for i, number in enumerate(numbers):
        length = bisect_left(ends, number, key=numbers.__getitem__)
        before.append(ends[length - 1] if length else None)
        ends[length : length + 1] = [i]
    positions, at = [], ends[-1] if ends else None
    while at is not None:
        positions.append(at)
        at = before[at]
    return positions[::-1]


def _copy(path: Path) -> Path:
    """Copy a damaged file next to it; older copies are kept."""
    copies = (
        path.with_name(f"{path.name}.damaged{n if n > 1 else ''}") for n in itertools.count(1)
    )
    copy = next(each for each in copies if not os.path.lexists(each))
    try:
        shutil.copyfile(path, copy)
    except OSError:
        copy.unlink(missing_ok=True)
        raise
    return copy


def _offer(generations: IntArray, generation: int) -> str:
    """The available generations, for an error."""
    if not len(generations):
        return "none is"
    first, last = int(generations[0]), int(generations[-1])
    if first == last:
        return f"only {first} is"
    every = "" if generations[1] - first == 1 else f" in steps of {generations[1] - first}"
    return (
        f"stored are {first} to {last}{every}, the nearest is"
        f" {generations[np.abs(generations - generation).argmin()]}"
    )


def _row_type(parameters: int, observation: int) -> "np.dtype[Any]":
    normaliser: list[Any] = [("normaliser", "<f8", (2, observation))] if observation else []
    return np.dtype(
        [
            ("generation", "<i8"),
            ("mu", "<f8", (parameters,)),
            ("sigma", "<f8", (parameters,)),
            *normaliser,
        ]
    )


def _head(parameters: int, generations: int, observation: int) -> str:
    head: dict[str, Any] = {
        "version": _VERSION,
        "parameters": parameters,
        "every": every(parameters, generations, observation),
        "row": "<i8 generation, <f8[parameters] mu, <f8[parameters] sigma",
    }
    if observation:
        head |= {
            "observation": observation,
            "row": head["row"] + ", <f8[2, observation] normaliser",
        }
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
    if not isinstance(head, dict) or head.get("version") != _VERSION:
        raise ConfigError(f"{path} is not of version {_VERSION}")
    for name, least in (("parameters", 1), ("every", 1), ("observation", 0)):
        count = head.get(name, 0)
        if type(count) is not int or not least <= count < PARAMETERS_LIMIT:
            raise ConfigError(
                f"{path} is damaged: its first line says {str(count)[:20]} for {name}; {_ASIDE}"
            )
    return head, len(line)


def replace_text(path: Path, text: str) -> None:
    """Write a whole file, or (an OSError) leave the old one."""
    checkpoints.replace(path, text.encode())
