"""A run's folder: which files there are, and how they are written so that nothing is lost.

    config.json      the resolved configuration
    checkpoint       everything a resume needs, replaced after every generation
    progress.jsonl   one line a generation
    parameters       mu and sigma of every generation
    summary.json     what came out
    run.rrd          the recording;  replay.rrd  the best and the final rollout at physics rate
    log.txt          what was said

docs/files.md describes them. The checkpoint is written last: what the other files hold beyond it
is cut off when the run is resumed.
"""

import fcntl
import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import CheckpointError, ConfigError
from farm.net.stats import GenerationStats
from learner import checkpoint as checkpoints
from learner import config as configs
from learner.checkpoint import Checkpoint
from learner.config import RunConfig

PARAMETERS_LIMIT: Final = 100_000_000
"""Size from which `parameters` keeps only every k-th generation [bytes]."""

_PARAMETERS_VERSION: Final = 1


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
    def replay(self) -> Path:
        """The recording at physics rate."""
        return self.path / "replay.rrd"

    @property
    def log(self) -> Path:
        """The log file."""
        return self.path / "log.txt"

    @property
    def checkpoint(self) -> Path:
        """The checkpoint."""
        return self.path / "checkpoint"

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> "RunFolder":
        """A new folder with its configuration.

        Raises:
          ConfigError: it exists, or cannot be made.
        """
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            raise ConfigError(
                f"run folder {path} exists and is never overwritten: choose another --name, or --resume {path}"
            ) from None
        except OSError as error:
            raise ConfigError(f"cannot make the run folder {path}: {error.strerror}") from None
        folder = cls(path)
        try:
            folder.write_config(config)
        except OSError as error:
            folder.discard()
            raise ConfigError(f"cannot write to the run folder {path}: {error.strerror}") from None
        return folder

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """An existing run's folder.

        Raises:
          ConfigError: there is none.
        """
        if not (path / "config.json").is_file():
            raise ConfigError(f"{path} is not a run's folder: it has no config.json")
        return cls(path)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other processes from going on with the run; released when this one ends, however it ends.

        Raises:
          ConfigError: another process holds it.
        """
        folder = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConfigError(f"another process is working on the run in {self.path}: let it end first") from None
            yield
        finally:
            os.close(folder)

    def discard(self) -> None:
        """Remove a new run that could not begin."""
        shutil.rmtree(self.path)

    def write_config(self, config: RunConfig) -> None:
        """Write config.json."""
        _replace(self.path / "config.json", json.dumps(configs.to_dict(config), indent=2) + "\n")

    def read_config(self) -> RunConfig:
        """Read config.json."""
        return configs.read(self.path / "config.json")

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        _replace(self.path / "summary.json", json.dumps(summary, indent=2) + "\n")

    def read_summary(self) -> dict[str, Any] | None:
        """Read summary.json, None when there is no readable one."""
        try:
            summary = json.loads((self.path / "summary.json").read_text("utf-8"))
        except (OSError, ValueError):
            return None
        return summary if isinstance(summary, dict) else None

    def append(self, progress: GenerationStats, mu: FloatArray, sigma: FloatArray, generations: int) -> None:
        """Add a generation to progress.jsonl and parameters."""
        with (self.path / "progress.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(progress.to_dict()) + "\n")
        path = self.path / "parameters"
        if not path.exists():
            _replace(path, _parameters_head(len(mu), generations))
        head, _ = _read_head(path)
        if progress.generation % head["every"] == 0:
            row = np.empty(1, _row_type(len(mu)))
            row["generation"], row["mu"], row["sigma"] = progress.generation, mu, sigma
            with path.open("ab") as binary:
                binary.write(row.tobytes())

    def progress(self) -> list[GenerationStats]:
        """Every whole line of progress.jsonl."""
        try:
            lines = (self.path / "progress.jsonl").read_text("utf-8", "replace").splitlines()
        except OSError:
            return []
        out = []
        for line in lines:
            try:
                out.append(GenerationStats.from_dict(json.loads(line)))
            except (ValueError, RecursionError):
                break  # torn by a crash, or of another version: nothing behind it is trusted
        return out

    def every(self, parameters: int, generations: int) -> int:
        """Every how many generations are kept in `parameters`, or would be of a new run."""
        path = self.path / "parameters"
        return int(_read_head(path)[0]["every"]) if path.exists() else every(parameters, generations)

    def parameters(self) -> "np.ndarray[Any, Any]":
        """Rows of `parameters`: fields generation, mu (P,) and sigma (P,).

        Raises:
          ConfigError: the file is missing or not one of this version.
        """
        path = self.path / "parameters"
        head, offset = _read_head(path)
        body = path.read_bytes()[offset:]
        kind = _row_type(head["parameters"])
        return np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)

    def mean(self, generation: int) -> FloatArray:
        """The mean mu after a generation, (P,).

        Raises:
          ConfigError: it is not in `parameters`; says what is.
        """
        rows = self.parameters()
        kept = rows["generation"]
        found = np.flatnonzero(kept == generation)
        if not len(found):
            raise ConfigError(f"generation {generation} is not stored in {self.path}: {_offer(kept, generation)}")
        mu: FloatArray = rows["mu"][found[0]]
        return mu

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the checkpoint."""
        checkpoints.save(self.checkpoint, checkpoint)

    def rewind(self, checkpoint: Checkpoint) -> None:
        """Cut the other files back to a checkpoint.

        Raises:
          CheckpointError: it cannot be used.
        """
        generation = checkpoint.state.get("generation")
        if type(generation) is not int:
            raise CheckpointError(f"{self.checkpoint} holds no generation")
        kept = [p for p in self.progress() if p.generation <= generation]
        lines = "".join(json.dumps(p.to_dict()) + "\n" for p in kept)
        _replace(self.path / "progress.jsonl", lines)
        path = self.path / "parameters"
        if path.exists():
            rows = self.parameters()
            head, offset = _read_head(path)
            whole = int((rows["generation"] <= generation).sum()) * _row_type(head["parameters"]).itemsize
            with path.open("r+b") as file:
                file.truncate(offset + whole)


def every(parameters: int, generations: int) -> int:
    """Every how many generations are kept, so that the file stays below PARAMETERS_LIMIT."""
    size = _row_type(parameters).itemsize * max(generations, 1)
    return max(1, math.ceil(size / PARAMETERS_LIMIT))


def _offer(kept: IntArray, wanted: int) -> str:
    """Which generations there are instead of the wanted one."""
    if not len(kept):
        return "none is"
    nearest = kept[np.abs(kept - wanted).argmin()]
    return f"{len(kept)} from {kept[0]} to {kept[-1]} are, the nearest is {nearest}"


def _row_type(parameters: int) -> "np.dtype[Any]":
    return np.dtype([("generation", "<i8"), ("mu", "<f8", (parameters,)), ("sigma", "<f8", (parameters,))])


def _parameters_head(parameters: int, generations: int) -> str:
    head = {
        "version": _PARAMETERS_VERSION,
        "parameters": parameters,
        "every": every(parameters, generations),
        "row": "<i8 generation, <f8[parameters] mu, <f8[parameters] sigma",
    }
    return json.dumps(head) + "\n"


def _read_head(path: Path) -> tuple[dict[str, Any], int]:
    try:
        with path.open("rb") as file:
            line = file.readline(1000)
        head = json.loads(line)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except ValueError:
        raise ConfigError(f"{path} has no readable first line") from None
    if not isinstance(head, dict) or head.get("version") != _PARAMETERS_VERSION:
        raise ConfigError(f"{path} is not of version {_PARAMETERS_VERSION}")
    return head, len(line)


def _replace(path: Path, text: str) -> None:
    """Write a whole file or leave the old one."""
    aside = path.with_name(path.name + ".new")
    try:
        aside.write_text(text, "utf-8")
        aside.replace(path)
    except OSError:
        aside.unlink(missing_ok=True)
        raise
