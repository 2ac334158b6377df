"""A recording of a run on another machine, in its own folder, continued where its file ends."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rerun.chunk import RrdReader

from farm.errors import ConfigError, MessageError, RunError, writing
from farm.net.telemetry import RunEnd
from learner import config as configs
from learner.config import RunConfig
from learner.recording.drawing import Drawing
from learner.recording.files import compact, parts
from learner.recording.run import RunRecording
from learner.run_folder import RunFolder
from learner.telemetry.report import unpacked
from learner.telemetry.subscriber import Subscriber

_STATISTICS: Final = "/learning/return"  # an entity with one row per generation


@dataclass
class Remote:
    """A recording of a run on another machine."""

    recording: RunRecording
    folder: RunFolder | None
    """Folder of the files, None for none."""
    done: int
    """Generations that are recorded."""
    end: RunEnd | None = None
    """How the run ended, once it has."""

    def follow(self, subscriber: Subscriber, stopped: Callable[[], bool]) -> None:
        """Record until the run is over.

        Raises:
          RunError: the recording failed, or the run cannot be followed.
        """
        for message in subscriber.follow(self.done, stopped):
            for line in message.lines:
                self.recording.line(line.level, line.text)
            if isinstance(message, RunEnd):
                self._end(message)
            else:
                try:
                    self.recording.generation(unpacked(message))
                except MessageError as error:
                    raise RunError(f"the learner cannot be understood: {error}") from None
                self.done = message.generation
            if not self.recording.thread.settled():
                raise RunError("the recording ended too early; see the message above")

    def _end(self, end: RunEnd) -> None:
        self.end = end
        mean, best = (None if part is None else part.trajectory() for part in (end.mean, end.best))
        self.recording.end(self.done, mean, best, end.best_generation)
        if self.folder is not None:
            with writing(f"to {self.folder.path}"):
                self.folder.write_summary(end.summary)


@contextmanager
def open_remote(
    path: Path | None,
    *,
    name: str,
    config: RunConfig,
    serve: tuple[str, int] | None,
    drawing: Drawing,
) -> Iterator[Remote]:
    """Start a recording in a folder (None: serve only), or continue an existing one; `name` is its id.

    Raises:
      ConfigError: the folder is another run's or the learner's, or the address is in use.
    """
    folder = None if path is None else _folder(path, config)
    with nullcontext() if folder is None else folder.held():
        done = 0 if folder is None else _recorded(folder.recording)
        recording = RunRecording(
            None if folder is None else folder.recording, replay=None if path is None else path / "replay.rrd",
            run=name, config=config, drawing=drawing, done=done, serve=serve,
        )  # fmt: skip
        try:
            yield Remote(recording, folder, done)
        finally:
            recording.finish()


def _recorded(path: Path) -> int:
    """The last generation in a recording's files, 0 if there are none; truncated files are repaired first."""
    if parts(path):
        compact(path)
    try:
        chunks = (chunk for part in parts(path) for chunk in RrdReader(part).stream())
        batches = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == _STATISTICS]
    except Exception as error:  # Rerun's reader raises many types
        raise ConfigError(f"cannot read {path}: {error}; move it away, or choose a different --out") from None
    numbers = [
        batch.column("generation").cast("int64").to_pylist() for batch in batches if "generation" in batch.schema.names
    ]
    return max((number for column in numbers for number in column), default=0)


def _folder(path: Path, config: RunConfig) -> RunFolder:
    folder = RunFolder(path)
    if folder.checkpoint.exists():
        raise ConfigError(f"{path} is the learner's own folder, which it records itself: choose a different --out")
    with writing(f"to {path}", ConfigError):
        path.mkdir(parents=True, exist_ok=True)
        if (path / "config.json").exists():
            for setting, old, new in configs.other(folder.read_config(), config):
                raise ConfigError(
                    f"{path} holds another run of that name, with --{setting} {old} instead of {new}: "
                    "choose a different --out"
                )
        elif any(path.iterdir()):
            raise ConfigError(f"{path} is no recording's folder, and not empty: choose a different --out")
        folder.write_config(config)
    return folder
