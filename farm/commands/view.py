"""`farm view`: a run's recording in the Rerun viewer."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import arguments
from farm.errors import ConfigError
from farm.local import check_rerun


@dataclass(frozen=True, kw_only=True)
class ViewCommand:
    """Opens a run's recording in the Rerun viewer."""

    run: tyro.conf.Positional[Path]
    """Folder of the run, or a recording (.rrd)."""
    web: bool = False
    """Serve the viewer to a browser on this machine instead of opening a window."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ViewCommand, words, "farm view")
    check_rerun()
    from learner.recording.files import parts

    files = [command.run] if command.run.is_file() else parts(command.run / "run.rrd")
    if not files:
        raise ConfigError(f"no recording in {command.run}: give a run's folder or a .rrd file")
    if not command.web and not _display():
        raise ConfigError(
            f"no display to open a window on: --web serves a browser, or copy {files[0]} to another machine"
        )
    flags = ["--web-viewer"] if command.web else []
    return subprocess.run(
        [sys.executable, "-m", "rerun", *map(str, files), "--bind", "127.0.0.1", *flags], check=False
    ).returncode


def _display() -> bool:
    """Whether a window can be opened; only Linux says."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
