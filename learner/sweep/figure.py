"""The figure of a sweep; the package's only module that imports matplotlib, which is an extra."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from learner.sweep.outcomes import Curve

INSTALL: Final = "figures need matplotlib: pip install matplotlib"

_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
"""Colours of Okabe and Ito, for the colour-blind; after the last one, dashes change."""

_DASHES: Final = ("-", "--", ":", "-.")
_STYLE: Final = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
    "svg.hashsalt": "rolloutfarm", "svg.fonttype": "none",
}  # fmt: skip


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def draw(curves: Sequence[Curve], path: Path, rungs: Sequence[int] = ()) -> None:
    """The mean policy's return over rollouts: mean over the seeds, standard deviation shaded; an SVG file.

    A race has `rungs`: numbers of rollouts at which entries were dropped. Its axis is logarithmic, as they are.

    Raises:
      OSError: it cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        canvas = Figure(figsize=(7.0, 4.2), layout="constrained")
        axis = canvas.subplots()
        for i, curve in enumerate(curves):
            colour, dash = _COLOURS[i % len(_COLOURS)], _DASHES[i // len(_COLOURS) % len(_DASHES)]
            mean, deviation = np.nanmean(curve.returns, axis=0), np.nanstd(curve.returns, axis=0)
            axis.plot(curve.rollouts, mean, color=colour, linestyle=dash, lw=1.5, label=curve.label)
            axis.fill_between(curve.rollouts, mean - deviation, mean + deviation, color=colour, alpha=0.15, lw=0)
        axis.set(xlabel="rollouts", ylabel="return of the mean policy, nominal start")
        if rungs:
            axis.set_xscale("log")
            for rung in rungs:
                axis.axvline(rung, color="0.8", lw=0.8, zorder=0)
        if len(curves) > 1:
            axis.legend(fontsize=8, loc="best")
        canvas.savefig(path, metadata={"Date": None, "Creator": None})
