"""A run's folder: its files, and writing them so that nothing is lost.

    config.json      the resolved configuration
    checkpoint       everything a resume needs, replaced after every generation
    progress.jsonl   one line per generation
    parameters       mu and sigma of every generation
    chain            a digest per generation
    summary.json     the results
    run.rrd          the recording;  replay.rrd  the best and the final rollout at physics rate
    log.txt          the messages
    states/          checkpoints from before hosts' first answers, to go back to if one is expelled
    undone.rrd       the recording of what was undone when a host was expelled
    assets/          files that its task's model reads, such as meshes, named by their SHA-256

docs/files.md describes them. The checkpoint is written last. When the run is resumed, newer entries
of the other files are removed, damaged lines of progress.jsonl are dropped, and a copy of the
damaged file is kept.
"""

import fcntl
import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import CheckpointError, ConfigError, NameTakenError
from farm.near import nearest
from farm.net.stats import GenerationStats
from farm.sim.model_files import Content, Files, by_digest, joined
from farm.sim.model_files import digest as digest_of
from farm.targets import typed
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.files import NONE, ParametersFile, ProgressFile, replace_text
from learner.run.hash_chain import ChainEntry, ChainFile
from learner.run.states import States

log = logging.getLogger(__name__)

_NUMBER: Final = (float, int, type(None))
_SUMMARY: Final = {
    **dict.fromkeys(("run", "state", "parameters_sha256"), (str, type(None))),
    **dict.fromkeys(("seed", "generations", "rollouts"), (int,)),
    **dict.fromkeys(
        (
            *("seconds", "mean_policy_return", "robust_success_rate", "robust_return"),
            "robust_score",
        ),
        _NUMBER,
    ),
    "mean_policy_success": (bool, type(None)),
}
"""Types of the displayed values of a summary."""


def opened(
    path: str | Path, allow_file: str | Path | Sequence[str | Path] | None = None
) -> "RunFolder":
    """An existing run's folder, with a file or files that the user named; a ConfigError if there is
    none.
    """
    if not isinstance(path, str | Path):
        raise ConfigError(f"a run's folder is {path!r:.60}; expected a path")
    files = (allow_file,) if isinstance(allow_file, str | Path) else allow_file or ()
    if not isinstance(files, tuple | list) or not all(isinstance(f, str | Path) for f in files):
        raise ConfigError(f"allow_file is {allow_file!r:.60}; expected a file, or several")
    return RunFolder.open(Path(path), tuple(Path(each) for each in files))


def like(path: Path) -> str:
    """`; did you mean RUN?` with the run in this folder's parent, or in `runs`, that has a similar
    name; or nothing.
    """
    runs: dict[str, Path] = {}
    for place in (Path("runs"), path.parent):
        with suppress(OSError):
            runs |= {file.parent.name: file.parent for file in place.glob("*/config.json")}
    near = nearest(path.name, runs)
    return f"; did you mean {runs[near]}?" if near else ""


@dataclass(frozen=True)
class RunFolder:
    """The files of one run."""

    path: Path
    allowed: tuple[Path, ...] = ()
    """Files that the user named: classes in files of these names are taken from them."""

    @property
    def name(self) -> str:
        """The run's name."""
        return self.path.resolve().name

    @property
    def there(self) -> bool:
        """Whether the folder can be opened: it may have been removed."""
        return (self.path / "config.json").is_file()

    @property
    def gone(self) -> str:
        """Message for a folder that is no longer there."""
        return f"the run's folder {self.path} was removed or emptied while it learnt"

    @property
    def recording(self) -> Path:
        """The Rerun recording."""
        return self.path / "run.rrd"

    @property
    def checkpoint(self) -> Path:
        """The checkpoint."""
        return self.path / "checkpoint"

    @property
    def states(self) -> States:
        """States to go back to."""
        return States(self.path / "states")

    def check_new(self) -> None:
        """Check that no run has this folder; raises NameTakenError if one does."""
        if os.path.isdir(self.path):  # noqa: PTH112  never raises
            raise NameTakenError(
                f"run folder {self.path} exists and is never overwritten: choose a different"
                f" --name, or --resume {typed(self.path)}"
            )
        above = next(each for each in self.path.absolute().parents if each.exists())
        if not above.is_dir():
            raise ConfigError(f"cannot make the run folder {self.path}: {above} is a file")

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> "RunFolder":
        """Make a new folder with its configuration.

        Raises:
          ConfigError: it exists, or cannot be made.
        """
        try:
            path.mkdir(parents=True)
        except OSError as error:
            cls(path).check_new()
            raise ConfigError(
                f"cannot make the run folder {path}: {_in_the_way(path) or error.strerror}"
            ) from None
        folder = cls(path)
        try:
            folder.write_config(config)
        except OSError as error:
            folder.discard()
            raise ConfigError(f"cannot write to the run folder {path}: {error.strerror}") from None
        return folder

    @classmethod
    def open(cls, path: Path, files: tuple[Path, ...] = ()) -> "RunFolder":
        """Open an existing run's folder, with files that the user named; a ConfigError if there
        is none.
        """
        if not cls(path).there:
            why = "it has no config.json" if path.exists() else "it does not exist"
            raise ConfigError(f"{path} is not a run's folder: {why}{like(path)}")
        for each in path.iterdir():
            # To open a FIFO would wait for ever
            if each.exists() and not (each.is_file() or each.is_dir()):
                raise CheckpointError(
                    f"{each} is not a file; expected one that the run wrote: remove it"
                )
        for each in files:
            if not each.is_file():
                raise ConfigError(f"--allow-file {each}: there is no such file")
        return cls(path, files)

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

    def keep_files(self, files: Files) -> None:
        """Keep those that are no texts, each once."""
        for digest, content in by_digest(files).items():
            path = self.path / "assets" / digest
            if not path.is_file():
                path.parent.mkdir(exist_ok=True)
                checkpoints.replace(path, content, sync=True)

    def files(self, at: Checkpoint) -> dict[str, Content]:
        """The files of a checkpoint's task, texts and others.

        Raises:
          CheckpointError: one is missing or damaged.
        """
        contents: dict[str, bytes] = {}
        for name, digest in at.assets.items():
            path = self.path / "assets" / digest
            content = path.read_bytes() if path.is_file() else b""
            if digest_of(content) != digest:
                raise CheckpointError(
                    f"{path}, the run's {name}, is missing or damaged: put the file back there"
                )
            contents[digest] = content
        return joined(at.files, at.assets, contents)

    def discard(self) -> None:
        """Remove a new run that could not start."""
        shutil.rmtree(self.path)

    def write_config(self, config: RunConfig) -> None:
        """Write config.json."""
        replace_text(
            self.path / "config.json", json.dumps(configs.to_dict(config), indent=2) + "\n"
        )

    def read_config(self) -> RunConfig:
        """Read config.json."""
        return configs.read(self.path / "config.json", self.allowed, self.path)

    def config_of(self, at: Checkpoint) -> RunConfig:
        """The configuration in one of its checkpoints."""
        return configs.from_dict(at.config, str(self.checkpoint), self.allowed, self.path)

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        replace_text(self.path / "summary.json", json.dumps(summary, indent=2) + "\n")

    @property
    def ended(self) -> bool:
        """Whether the run has come to its end, and has not gone on since."""
        return (self.read_summary() or {}).get("state") == "finished"

    def forget_summary(self) -> None:
        """Remove summary.json, whose results are no longer the run's."""
        (self.path / "summary.json").unlink(missing_ok=True)

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
        normaliser: FloatArray = NONE,
        entry: ChainEntry | None = None,
    ) -> None:
        """Add a generation to progress.jsonl, parameters and chain: mu and sigma (P,), and a
        normaliser (2, d).
        """
        self.forget_summary()
        if entry is not None:
            self.chain.append(progress.generation, entry)
        self._progress.append(progress)
        self.parameters.append(progress.generation, mu, sigma, generations, normaliser)

    def progress(self) -> list[GenerationStats]:
        """Every readable line of progress.jsonl, in order of generations."""
        return self._progress.read()

    def progress_after(self, generation: int) -> Iterator[GenerationStats]:
        """Lines of progress.jsonl of later generations, in order; only they are read."""
        return self._progress.after(generation)

    def last_progress(self) -> GenerationStats | None:
        """The last readable line of progress.jsonl, None if there is none; reads the end of the
        file only.
        """
        return self._progress.last()

    @property
    def parameters(self) -> ParametersFile:
        """Mu and sigma of the generations."""
        return ParametersFile(self.path / "parameters")

    @property
    def chain(self) -> ChainFile:
        """Digests of the generations."""
        return ChainFile(self.path / "chain")

    @property
    def _progress(self) -> ProgressFile:
        return ProgressFile(self.path / "progress.jsonl")

    def save(self, checkpoint: Checkpoint, *, durable: bool = True) -> None:
        """Replace the checkpoint; durable: also safe against a power failure."""
        if durable:  # first the files that it relies on
            for name in ("config.json", "progress.jsonl", "parameters", "chain"):
                with suppress(FileNotFoundError):
                    checkpoints.flush(self.path / name)
        checkpoints.save(self.checkpoint, checkpoint, durable=durable)

    def settle(self) -> None:
        """Flush the checkpoint to the disk, and delete its copy."""
        checkpoints.settle(self.checkpoint)

    def truncate(self, checkpoint: Checkpoint) -> None:
        """Remove entries of the other files that are newer than the checkpoint, and results that
        are not of its generation.

        Raises:
          CheckpointError: it cannot be used.
        """
        generation = checkpoint.state.get("generation")
        if type(generation) is not int:
            raise CheckpointError(f"{self.checkpoint} holds no generation")
        size = np.asarray(checkpoint.state.get("mu")).size
        whole = self.parameters.until(generation, size, self.checkpoint.name)  # raises if unusable
        if (self.read_summary() or {}).get("generations") != generation:
            self.forget_summary()
        self._progress.truncate(generation)
        self.chain.truncate(generation)
        self.parameters.truncate(whole)
        self.states.forget_after(generation)


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
    values = [(summary[name], kinds) for name, kinds in _SUMMARY.items() if name in summary]
    return all(
        type(value) in kinds and (type(value) is not int or abs(value) < 2**63)
        for value, kinds in values
    )
