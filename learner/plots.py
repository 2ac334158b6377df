"""Drawing of figures: their style and file.

The package's only module that imports matplotlib, which is an extra.
"""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from farm.commands.logs import say

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INSTALL: Final = "figures need matplotlib: pip install matplotlib"

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
"""Colours of Okabe and Ito, for the colour-blind; after the last one, dashes change."""

DASHES: Final = ("-", "--", ":", "-.")
_STYLE: Final = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "svg.hashsalt": "rolloutfarm",
    "svg.fonttype": "none",
}


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def announce() -> None:
    """Say in one line that there will be no figure, and how to get it, before the work that it
    would show.
    """
    if not available():
        say(f"there will be no figure: {INSTALL}")


@contextmanager
def canvas(path: Path, width: float, height: float) -> Iterator["Figure"]:
    """An empty figure of a size [inches], which is written to an SVG file after it has been drawn.

    Raises:
      OSError: it cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        figure.savefig(path, metadata={"Date": None, "Creator": None})
