"""The chain of a run: a digest per generation, of its numbers, the run's settings and the previous
generation's digest.

Two runs with the same settings have the same chain, whichever workers they had, and however often
they were resumed: what differs between machines (seconds, workers, hosts) is not in it. So its last
digest names all numbers of a run.
"""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from farm.arrays import FloatArray
from farm.net import codec
from farm.net.stats import GenerationStats
from learner.run import config as configs
from learner.run.checkpoint import SCHEMA, Checkpoint
from learner.run.config import RunConfig
from learner.run.files import replace_text
from learner.run.shrinking import Shrinking

OF_MACHINES: Final = ("reissued", "workers", "seconds")
"""Fields of progress.jsonl that differ between executions."""


@dataclass(frozen=True)
class ChainEntry:
    """A generation's entry."""

    digest: str
    """Digest of the generation's numbers and the previous digest."""
    state: str
    """Digest of the checkpoint after the generation."""


def first(config: RunConfig, written: Mapping[str, Any] | None = None) -> str:
    """The digest before the first generation: of all settings but those of the run's end, without
    folders.

    Of a run that an earlier release has `written` down (its config.json), settings that it did not
    have are left out.
    """
    settings = configs.flat(config)
    if written is not None:
        parts = [written, *(values for values in written.values() if isinstance(values, Mapping))]
        names = {name.replace("_", "-") for part in parts for name in part}
        settings = {name: value for name, value in settings.items() if name in names}
    left_out = configs.AT_THE_END
    table = {
        name: str(value).rpartition("/")[2]
        for name, value in settings.items()
        if name not in left_out
    }
    return hashlib.sha256(json.dumps(table, sort_keys=True).encode()).hexdigest()


def state_of(at: Checkpoint) -> str:
    """Digest of a checkpoint, but for what is of machines, names, code and the run's end."""
    bare = replace(
        at,
        run="",
        config={},
        reissued=0,
        seconds=0.0,
        fingerprint="",
        replayed=False,
        code={},
        expelled={},
        checks={},
        first={},
        undone=0,
        chain="",
    )
    without = {"last_score"} if at.validated else {"last_score", "validated"}
    if at.shrinking == Shrinking():
        without.add("shrinking")
    return hashlib.sha256(codec.encode(bare, SCHEMA, without)).hexdigest()


def following(
    before: str,
    line: GenerationStats,
    mu: FloatArray,
    sigma: FloatArray,
    normaliser: FloatArray,
    state: str,
) -> str:
    """The digest of a generation.

    Args:
      before: that of the generation before it.
      line: its line of progress.jsonl.
      mu: after it, (P,).
      sigma: after it, (P,).
      normaliser: after it, (2, d) or (2, 0).
      state: that of `state_of`.
    """
    numbers = {name: value for name, value in line.to_dict().items() if name not in OF_MACHINES}
    sha256 = hashlib.sha256(f"{before} {state} {json.dumps(numbers, sort_keys=True)}\n".encode())
    for values in (mu, sigma, normaliser):
        sha256.update(values.astype("<f8").tobytes())
    return sha256.hexdigest()


@dataclass(frozen=True)
class ChainFile:
    """The file: a line `GENERATION DIGEST STATE` per generation."""

    path: Path

    def append(self, generation: int, entry: ChainEntry) -> None:
        """Add a generation."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(_line(generation, entry))

    def read(self) -> Mapping[int, ChainEntry]:
        """Every readable line, by generation; the last one of several."""
        entries: dict[int, ChainEntry] = {}
        with suppress(OSError):
            for words in map(str.split, self.path.read_text("utf-8", "replace").splitlines()):
                if len(words) == 3 and words[0].isdecimal() and len(words[0]) < 20:
                    entries[int(words[0])] = ChainEntry(*words[1:])
        return entries

    def truncate(self, generation: int) -> None:
        """Remove what is newer than a generation."""
        if self.path.exists():
            remaining = (
                (at, entry) for at, entry in sorted(self.read().items()) if at <= generation
            )
            replace_text(self.path, "".join(_line(at, entry) for at, entry in remaining))


def _line(generation: int, entry: ChainEntry) -> str:
    return f"{generation} {entry.digest} {entry.state}\n"
