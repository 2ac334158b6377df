"""`farm record`: records a run over the network, on any machine."""

import subprocess
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from farm import settings as arguments
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import display
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError
from farm.net import keys, session
from farm.net.session import LISTEN
from farm.net.tls import find
from learner.commands import options, recordings
from learner.run import check_rerun

if TYPE_CHECKING:
    from learner.recording.remote import Remote


@dataclass(frozen=True, kw_only=True)
class RecordCommand:
    """Records a run over the network, on any machine: the whole run, even if the command starts late."""

    connect: tuple[str, ...] = ()
    """Where a learner or a router listens, repeatable; by default tcp/127.0.0.1:7447."""
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
    farm: str = "farm"
    """Name of the farm."""
    tls: Path | None = None
    """Folder with certificates: a viewer's bundle."""
    name: str = ""
    """Which viewer's certificate to use, if the folder holds several."""
    allow_file: tuple[Path, ...] = ()
    """A copy of the file with the run's task or policy, if it is a file on the learner's machine; repeatable."""
    log_level: str = "INFO"
    """Messages from this level on: DEBUG | INFO | WARNING | ERROR."""

    def __post_init__(self) -> None:
        keys.checked("farm", self.farm)
        if self.run:
            keys.checked("run", self.run)
        if self.serve is not None:
            options.address(self.serve)
        if not (self.file or self.serve or self.spawn):
            raise ConfigError("--no-file records nothing: add --serve PORT or --spawn")
        if self.spawn and not display():
            raise ConfigError("no display to open a window on: take --serve PORT, and open the viewer elsewhere")

    @property
    def address(self) -> tuple[str, int] | None:
        """Where to serve; a viewer of our own finds any port."""
        if self.serve is not None:
            return options.address(self.serve)
        return ("127.0.0.1", 0) if self.spawn else None


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(RecordCommand, words, "farm record")
    check_rerun()
    logs.set_up(command.log_level)
    with stop_flag("ending") as stop:
        remote = record(command, stop.is_set)
    where = "" if remote.folder is None else f" in {remote.folder.path}"
    if remote.end is None:
        say(f"recorded up to generation {remote.done}{where}; the same command continues")
        return INTERRUPTED
    say(f"run over after generation {remote.done}, all recorded{where}")
    if remote.folder is not None:
        say(f"look at it with: farm view {remote.folder.path}")
    return 0


def record(command: RecordCommand, stopped: Callable[[], bool]) -> "Remote":
    """Follow a run to its end, or until stopped."""
    from learner.recording.drawing import Drawing
    from learner.recording.remote import open_remote
    from learner.setup import problem
    from learner.telemetry.subscriber import Subscriber, find_run

    bundle = None if command.tls is None else find(command.tls, "viewer", command.name)
    endpoints = command.connect or (LISTEN if bundle is None else LISTEN.replace("tcp/", "tls/"),)
    with ExitStack() as kept:
        # The session closes first: the learner waits for that at the end, while the file is still being merged.
        with session.connect(endpoints, None, stopped, bundle) as link:
            run = command.run or find_run(link, command.farm, stopped)
            follower = Subscriber(link, command.farm, run, command.allow_file)
            name, config, files = follower.begin(stopped)
            path = command.out / run if command.file else None
            drawing = Drawing.of(problem(config, files=files))
            opened = open_remote(path, name=name, config=config, serve=command.address, drawing=drawing)
            remote = kept.enter_context(opened)
            _announce(run, remote, spawn=command.spawn)
            remote.follow(follower, stopped)
        return remote


def _announce(run: str, remote: "Remote", *, spawn: bool) -> None:
    done = f", continuing after generation {remote.done}" if remote.done else ""
    into = "" if remote.folder is None else f" into {remote.folder.path}"
    uri = remote.recording.uri
    say(f"recording run {run}{into}{done}", *([] if uri is None else recordings.look_on(uri)))
    if spawn and uri is not None:
        # In a session of its own: the window stays open until the user closes it. A viewer listens, too.
        flags = ("--bind", "127.0.0.1", "--port", "auto")
        from learner.recording.files import program

        subprocess.Popen([program(), uri, *flags], start_new_session=True)
