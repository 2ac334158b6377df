"""`farm view`: recordings of runs in the Rerun viewer."""

import os
import socket
import subprocess
import webbrowser
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote, urlsplit

import tyro

from farm import command_line
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import display
from farm.commands.signals import stop_flag
from farm.errors import ConfigError, Interrupted, RunError
from farm.processes import end
from farm.settings import Settings
from farm.targets import typed
from learner.commands import recordings
from learner.recording.files import check_rerun

_PAGE = 9090  # port for a browser, if it is free
_LOOK = 0.1  # [s] between two checks of the viewer
_CLOSING = 5.0  # [s] for it to end


@dataclass(frozen=True, kw_only=True)
class ViewCommand(Settings):
    """Opens recordings of runs in the Rerun viewer; several runs together, with a table of them."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, recordings (.rrd), or the address of a live stream."""
    web: bool = False
    """Serve the viewer to a browser on this machine instead of opening a window."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(ViewCommand, words, "farm view")
    logs.set_up("WARNING")
    check_rerun()
    if not command.runs:
        raise ConfigError("nothing to open: give a run's folder or a .rrd file")
    sources = [recordings.sources(what) for what in command.runs]
    if not command.web:
        check_display(command.runs[0])
    return show(
        [source for group in sources for source in group], web=command.web, table=len(sources) > 1
    )


def check_display(what: str) -> None:
    """Check that a window can be opened; raises ConfigError otherwise."""
    if not display():
        raise ConfigError(
            f"no display to open a window on: farm view {typed(what)} --web serves a browser, or"
            " copy the recording elsewhere"
        )


def show(sources: Sequence[str], *, web: bool = False, table: bool = False) -> int:
    """Open files or live streams in a window or browser, with their table first if requested, until
    it is closed.

    Raises:
      RunError: the viewer failed.
      Interrupted: Ctrl-C or SIGTERM, which end the viewer as well.
    """
    from learner.recording.files import program, quiet
    from learner.recording.viewing import free_port, listens, once_loaded, show_table

    port, page = free_port(), free_port(_PAGE)
    command = [program(), *sources, "--bind", "127.0.0.1", "--port", str(port)]
    command += ["--serve-web", "--web-viewer-port", str(page)] if web else []
    with stop_flag("closing the viewer") as stop, ExitStack() as stack:
        # Its own messages name an address that ssh does not forward. A server has no settings of
        # the user's to keep.
        home = Path(stack.enter_context(TemporaryDirectory()))
        viewer = stack.enter_context(
            subprocess.Popen(command, env=quiet(home) if web else {"RUST_LOG": "warn"} | os.environ)
        )
        try:

            def gone() -> bool:
                return viewer.poll() is not None or stop.is_set()

            if table and not web:
                once_loaded(port, gone, show_table)
            elif web and listens(page, gone):
                live = [source for source in sources if "://" in source]  # a browser can open these
                address, tunnel = _address(page, live or [f"rerun+http://127.0.0.1:{port}/proxy"])
                say(f"open {address}   {tunnel}")
                if display():
                    webbrowser.open(address)  # not by Rerun: its home here is not the user's
            while viewer.poll() is None and not stop.wait(_LOOK):
                pass
        finally:
            end([viewer], _CLOSING)
    if stop.is_set():
        raise Interrupted("the viewer is closed")
    hint = "see above" if web else "is a display available? --web serves a browser instead"
    if viewer.returncode:
        raise RunError(f"Rerun's viewer ended with status {viewer.returncode}: {hint}")
    return 0


def _address(page: int, streams: Sequence[str]) -> tuple[str, str]:
    """The viewer's address with these streams for a browser, and how to reach it from another
    machine.
    """
    ports = [page, *(urlsplit(stream).port for stream in streams)]
    tunnels = " ".join(f"-L {port}:127.0.0.1:{port}" for port in ports)
    query = "&".join(f"url={quote(stream, safe='')}" for stream in streams)
    return (
        f"http://127.0.0.1:{page}/?{query}",
        f"(from elsewhere: ssh {tunnels} {socket.gethostname()} first)",
    )
