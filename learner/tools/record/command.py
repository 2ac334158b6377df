"""`farm record`: records a run over the network, on any machine."""

import subprocess
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from farm import command_line
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import display
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, RunError, writing
from farm.link import Joining
from farm.net import keys, session
from farm.targets import typed
from learner.commands import options, recordings
from learner.recording.files import check_rerun
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.states import RolledBack

if TYPE_CHECKING:
    from learner.recording.run import RunRecording


@dataclass(frozen=True, kw_only=True)
class RecordCommand(Joining):
    """Records a run over the network, on any machine: the whole run, even if the command starts
    late.
    """

    run: str = ""
    """Name of the run; by default the only run on the farm, or the first that appears."""
    out: Path = Path("recordings")
    """Folder in which the recording's folder is made."""
    file: bool = True
    """Write run.rrd and replay.rrd."""
    serve: str | None = None
    """Also stream the recording live, at [HOST:]PORT (host: 127.0.0.1)."""
    spawn: bool = False
    """Open a viewer on the live stream."""
    allow_file: tuple[Path, ...] = ()
    """A copy of the file with the run's task or policy, if it is a file on the learner's machine;
    repeatable.
    """
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.run:
            keys.checked("run", self.run)
        if self.serve is not None:
            options.address(self.serve)
        if not (self.file or self.serve or self.spawn):
            raise ConfigError("--no-file records nothing: add --serve PORT or --spawn")
        if self.spawn and not display():
            raise ConfigError(
                "no display to open a window on: take --serve PORT, and open the viewer elsewhere"
            )

    @property
    def address(self) -> tuple[str, int] | None:
        """Where to serve; a viewer of our own finds any port."""
        if self.serve is not None:
            return options.address(self.serve)
        return ("127.0.0.1", 0) if self.spawn else None


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(RecordCommand, words, "farm record")
    check_rerun()
    logs.set_up(command.log_level)
    with stop_flag("ending") as stop:
        recording, folder = record(command, stop.is_set)
    where = "" if folder is None else f" in {folder.path}"
    if recording.end is None:
        say(f"recorded up to generation {recording.done}{where}; the same command continues")
        return INTERRUPTED
    say(f"run over after generation {recording.done}, all recorded{where}")
    if folder is not None:
        say(f"look at it with: farm view {typed(folder.path)}")
    return 0


def record(
    command: RecordCommand, stopped: Callable[[], bool]
) -> "tuple[RunRecording, RunFolder | None]":
    """Follow a run to its end, or until stopped.

    Returns its recording, and the folder if there is one.

    A run that goes back to an earlier generation is recorded anew, in a folder of its own.

    Raises:
      ConfigError: the folder is another run's or the learner's, or the address is in use.
      RunError: the recording failed, or the run cannot be followed.
    """
    while True:
        try:
            return _record(command, stopped)
        except RolledBack as reason:
            say(f"{reason}; what is recorded stays, and the run is recorded anew")


def _record(
    command: RecordCommand, stopped: Callable[[], bool]
) -> "tuple[RunRecording, RunFolder | None]":
    from learner.recording.drawing import Drawing
    from learner.recording.files import last_generation
    from learner.recording.run import open_recording
    from learner.run.setup import problem
    from learner.telemetry.subscriber import Subscriber, find_run

    with ExitStack() as stack:
        # The session closes first: the learner waits for that at the end, while the file is still
        # being merged.
        with session.connect(command.endpoints, command.timeout, stopped, command.bundle) as link:
            run = command.run or find_run(link, command.farm, stopped)
            subscriber = Subscriber(link, command.farm, run, command.allow_file)
            name, config, files = subscriber.begin(stopped)
            label = f"{run}-undone{subscriber.undone}" if subscriber.undone else run
            folder = _folder(command.out / label, config) if command.file else None
            if folder is not None:
                stack.enter_context(folder.held())
            recording = stack.enter_context(
                open_recording(
                    folder.recording if folder else None,
                    run=name,
                    config=config,
                    serve=command.address,
                    drawing=Drawing.of(problem(config, files=files)),
                    done=last_generation(folder.recording) if folder else 0,
                )
            )
            _announce(run, recording, folder, spawn=command.spawn)
            for message in subscriber.follow(recording.done, stopped):
                recording.put(message)
                if folder is not None and recording.end is not None:
                    with writing(f"to {folder.path}"):
                        folder.write_summary(recording.end.summary)
                recorded = recording.taken() if recording.end is None else recording.settled()
                if not recorded:
                    raise RunError("the recording ended too early; see the message above")
        return recording, folder


def _folder(path: Path, config: RunConfig) -> RunFolder:
    """The recording's own folder, new or begun before; a ConfigError if it is another run's or
    the learner's.
    """
    folder = RunFolder(path)
    if folder.checkpoint.exists():
        raise ConfigError(
            f"{path} is the learner's own folder, which it records itself: choose a different --out"
        )
    with writing(f"to {path}", ConfigError):
        path.mkdir(parents=True, exist_ok=True)
        if (path / "config.json").exists():
            for setting, old, new in configs.other(folder.read_config(), config):
                raise ConfigError(
                    f"{path} holds another run of that name, with --{setting} {old} instead of"
                    f" {new}: choose a different --out"
                )
        elif any(path.iterdir()):
            raise ConfigError(
                f"{path} is no recording's folder, and not empty: choose a different --out"
            )
        folder.write_config(config)
    return folder


def _announce(
    run: str, recording: "RunRecording", folder: RunFolder | None, *, spawn: bool
) -> None:
    done = f", continuing after generation {recording.done}" if recording.done else ""
    into = "" if folder is None else f" into {folder.path}"
    uri = recording.uri
    say(f"recording run {run}{into}{done}", *([] if uri is None else recordings.look_on(uri)))
    if spawn and uri is not None:
        # In a session of its own: the window stays open until the user closes it. A viewer listens,
        # too.
        flags = ("--bind", "127.0.0.1", "--port", "auto")
        from learner.recording.files import program

        subprocess.Popen([program(), uri, *flags], start_new_session=True)
