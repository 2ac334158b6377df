"""Tables that fit into 80 columns, and are not folded where nobody sees them."""

from typing import Final

from rich.console import Console
from rich.table import Table

_WIDE: Final = 240  # columns of a file or a pipe


def compact(title: str | None = None) -> Table:
    """A table without lines."""
    return Table(title=title, box=None, pad_edge=False, padding=(0, 2, 0, 0), title_justify="left")


def wide() -> Console:
    """Standard output: as wide as the terminal, or wide enough for all."""
    console = Console()
    return console if console.is_terminal else Console(width=_WIDE)
