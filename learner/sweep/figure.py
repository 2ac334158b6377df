"""Figures of a sweep and of a stress test; the package's only module that imports matplotlib, which is an extra."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from learner.sweep.outcomes import Curve

INSTALL: Final = "figures need matplotlib: pip install matplotlib"

_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
"""Colours of Okabe and Ito, for the colour-blind; after the last one, dashes change."""

_CAUSES: Final = (*(colour for colour in _COLOURS if colour != "#000000"),)

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


def draw_stress(
    strengths: Sequence[float], curves: Mapping[str, tuple[Sequence[float], Sequence[float]]], word: str, path: Path
) -> None:
    """What a policy does over the strength of each cause, the last of which is all together; an SVG file.

    Args:
      strengths: S of them.
      curves: by cause the share (S,), which is empty without a `word`, and the mean return (S,).
      word: what the share is of.
      path: of the file.

    Raises:
      OSError: it cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        canvas = Figure(figsize=(7.0, 3.4), layout="constrained")
        shown = (0, 1) if word else (1,)
        axes = canvas.subplots(1, len(shown), squeeze=False)[0]
        for axis, at in zip(axes, shown, strict=True):
            for i, (cause, values) in enumerate(curves.items()):
                last = i + 1 == len(curves)
                colour = "black" if last else _CAUSES[i % len(_CAUSES)]
                dash = _DASHES[0 if last else i // len(_CAUSES) % len(_DASHES)]
                axis.plot(strengths, values[at], color=colour, linestyle=dash, lw=2.4 if last else 1.3, label=cause)
            axis.set(xlabel="times its range", ylabel=word if at == 0 else "mean return")
            if at == 0:
                axis.set_ylim(-0.03, 1.03)
        canvas.legend(*axes[0].get_legend_handles_labels(), fontsize=8, loc="outside right upper")
        canvas.savefig(path, metadata={"Date": None, "Creator": None})
