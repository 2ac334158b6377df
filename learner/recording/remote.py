"""A run's recording made elsewhere: a folder of its own, gone on with where its file ends."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rerun.chunk import RrdReader

from farm import tasks
from farm.errors import ConfigError, MessageError, RunError
from farm.net.telemetry import RunEnd, RunReport
from learner.config import RunConfig
from learner.recording.files import compact, parts
from learner.recording.run import Recording
from learner.run_folder import RunFolder
from learner.telemetry.report import unpacked
from learner.telemetry.subscriber import Follower, other

_STATISTICS: Final = "/learning/return"  # an entity that has one row a generation


@dataclass
class Remote:
    """A recording of a run that is learnt elsewhere."""

    recording: Recording
    folder: RunFolder | None
    """Where the files go, None for none."""
    done: int
    """Generations that are recorded."""
    end: RunEnd | None = None
    """How the run ended, once it has."""

    def follow(self, follower: Follower, stopped: Callable[[], bool]) -> None:
        """Record until the run is over.

        Raises:
          RunError: the recording failed, or the run cannot be followed.
        """
        for message in follower.follow(self.done, stopped):
            for line in message.lines:
                self.recording.line(line.level, line.text)
            if isinstance(message, RunEnd):
                self._end(message)
            else:
                self._generation(message)
            if not self.recording.settled():
                raise RunError("the recording ended before its time; the line above says why")

    def _generation(self, message: RunReport) -> None:
        try:
            self.recording.generation(unpacked(message))
        except MessageError as error:
            raise RunError(f"the learner cannot be understood: {error}") from None
        self.done = message.generation

    def _end(self, end: RunEnd) -> None:
        self.end = end
        mean, best = (None if part is None else part.trajectory() for part in (end.mean, end.best))
        self.recording.end(self.done, mean, best, end.best_generation)
        if self.folder is not None:
            try:
                self.folder.write_summary(end.summary)
            except OSError as error:
                raise RunError(f"cannot write to {self.folder.path}: {error.strerror}") from None


@contextmanager
def open_remote(path: Path | None, *, name: str, config: RunConfig, serve: tuple[str, int] | None) -> Iterator[Remote]:
    """Begin a recording in a folder, or go on with the one that is there.

    Args:
      path: the folder; None to serve only.
      name: the recording's id.
      config: the run's configuration.
      serve: host and port for viewers.

    Raises:
      ConfigError: the folder is another run's or the learner's, or the address is taken.
    """
    if path is None:
        with _recording(None, name, config, serve, 0) as recording:
            yield Remote(recording, None, 0)
        return
    folder = _folder(path, config)
    with folder.held():
        done = _recorded(folder.recording)
        with _recording(folder, name, config, serve, done) as recording:
            yield Remote(recording, folder, done)


@contextmanager
def _recording(
    folder: RunFolder | None, name: str, config: RunConfig, serve: tuple[str, int] | None, done: int
) -> Iterator[Recording]:
    path, replay = (None, None) if folder is None else (folder.recording, folder.replay)
    scene = tasks.scene(config.task)
    recording = Recording(path, replay=replay, run=name, config=config, scene=scene, done=done, serve=serve)
    try:
        yield recording
    finally:
        recording.finish()


def _recorded(path: Path) -> int:
    """The last generation that a recording's files hold, 0 where there are none; what is torn is mended first.

    Raises:
      ConfigError: a file cannot be read.
    """
    if parts(path):
        compact(path)
    try:
        chunks = (chunk for part in parts(path) for chunk in RrdReader(part).stream())
        batches = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == _STATISTICS]
    except Exception as error:  # Rerun's reader raises many kinds
        raise ConfigError(f"cannot read {path}: {error}; move it away, or choose another --out") from None
    numbers = [
        batch.column("generation").cast("int64").to_pylist() for batch in batches if "generation" in batch.schema.names
    ]
    return max((number for column in numbers for number in column), default=0)


def _folder(path: Path, config: RunConfig) -> RunFolder:
    folder = RunFolder(path)
    if folder.checkpoint.exists():
        raise ConfigError(f"{path} is the learner's own folder, which it records itself: choose another --out")
    try:
        path.mkdir(parents=True, exist_ok=True)
        if (path / "config.json").exists():
            for setting, old, new in other(folder.read_config(), config):
                raise ConfigError(
                    f"{path} holds another run of that name, with --{setting} {old} instead of {new}: "
                    "choose another --out"
                )
        elif any(path.iterdir()):
            raise ConfigError(f"{path} is no recording's folder, and not empty: choose another --out")
        folder.write_config(config)
    except OSError as error:
        raise ConfigError(f"cannot write to {path}: {error.strerror}") from None
    return folder
