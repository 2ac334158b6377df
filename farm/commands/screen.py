"""Whether there is a screen, drawing without one, and tables that fit into 80 columns.

Imports no MuJoCo, which looks at MUJOCO_GL once, when it is imported.
"""

import ctypes.util
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import rich.console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from farm.errors import printable

_WIDE: Final = 240  # columns of a file or a pipe, so that no lines are folded


class Console(rich.console.Console):
    """Rich's, whose reader may go away as that of any other output."""

    def on_broken_pipe(self) -> None:
        """Leave the error to the command line, which ends the program."""
        raise BrokenPipeError


def display() -> bool:
    """Whether a window can be opened; assumed to be possible on systems other than Linux."""
    return sys.platform != "linux" or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def draw_offscreen() -> None:
    """Let MuJoCo draw without a window if there is no screen; the user's own MUJOCO_GL is kept.

    Nothing is chosen if neither library is installed: MuJoCo could not even be imported then.
    """
    if display():
        return
    for name in ("OSMesa", "EGL"):
        if ctypes.util.find_library(name):
            os.environ.setdefault("MUJOCO_GL", name.lower())


def compact(title: str | None = None) -> Table:
    """A table without lines."""
    return Table(title=title, box=None, pad_edge=False, padding=(0, 2, 0, 0), title_justify="left")


def plain(text: object) -> Text:
    """Literal text: brackets are not styles, and control characters do not move the cursor."""
    return Text(printable(str(text)))


def figure(value: float | None, form: str = ".3f") -> str:
    """A number for display; a dash if it is not known."""
    return "-" if value is None else format(value, form)


@contextmanager
def bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show a bar on standard error while it is a terminal; yields what is to be told how much is
    done.
    """
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda count: progress.advance(task, count)


def wide(table: Table | None = None) -> Console:
    """Standard output: as wide as the terminal, at least as wide as the numbers of a table, or wide
    enough for all.
    """
    console = Console()
    if not console.is_terminal:
        return Console(width=_WIDE)
    if table is None:
        return console
    least = Measurement.get(console, console.options.update_width(_WIDE), table).minimum
    return console if least <= console.width else Console(width=least)
