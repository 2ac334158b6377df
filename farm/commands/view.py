"""`farm view`: recordings of runs in the Rerun viewer."""

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import arguments
from farm.commands.screen import display
from farm.commands.signals import stop_flag
from farm.errors import ConfigError, Interrupted
from farm.local import check_rerun

_LOOK = 0.1  # [s] between two looks at the viewer
_CLOSING = 5.0  # [s] that it has to end


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """Opens the recordings of runs in the Rerun viewer; those of several runs with a table of the runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, or recordings (.rrd)."""
    web: bool = False
    """Serve the viewer to a browser on this machine instead of opening a window."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ViewCommand, words, "farm view")
    check_rerun()
    if not command.runs:
        raise ConfigError("nothing to look at: give a run's folder or a .rrd file")
    files = [_files(path) for path in command.runs]
    if not command.web:
        check_display(files[0][0])
    return show([file for some in files for file in some], web=command.web, table=len(files) > 1)


def check_display(file: Path) -> None:
    """Whether a window can be opened.

    Raises:
      ConfigError: it cannot; says what to do.
    """
    if not display():
        raise ConfigError(f"no display to open a window on: --web serves a browser, or copy {file} to another machine")


def show(files: Sequence[Path], *, web: bool = False, table: bool = False) -> int:
    """Open recordings and wait until the viewer is closed; its exit status.

    Args:
      files: the recordings.
      web: serve a browser instead of opening a window.
      table: begin with the table of the recordings.

    Raises:
      Interrupted: Ctrl-C or SIGTERM, which end the viewer as well.
    """
    from learner.recording.viewing import free_port, program, show_table

    port = free_port()
    flags = ["--web-viewer"] if web else ["--port", str(port)]
    command = [program(), *map(str, files), "--bind", "127.0.0.1", *flags]
    with stop_flag("closing the viewer") as stop, subprocess.Popen(command) as viewer:
        try:
            if table and not web:
                show_table(port, lambda: viewer.poll() is not None or stop.is_set())
            while viewer.poll() is None and not stop.wait(_LOOK):
                pass
        finally:
            _end(viewer)
    if stop.is_set():
        raise Interrupted("the viewer is closed")
    return viewer.returncode


def _end(viewer: "subprocess.Popen[bytes]") -> None:
    """End a viewer that has not ended by itself."""
    viewer.terminate()
    try:
        viewer.wait(_CLOSING)
    except subprocess.TimeoutExpired:
        viewer.kill()


def _files(path: Path) -> list[Path]:
    """The recording's files.

    Raises:
      ConfigError: there are none.
    """
    from learner.recording.files import parts

    files = [path] if path.is_file() else parts(path / "run.rrd")
    if not files:
        raise ConfigError(f"no recording in {path}: give a run's folder or a .rrd file")
    return files
