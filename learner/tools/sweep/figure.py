"""The figure of a sweep, and of a race."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from learner.plots import COLOURS, DASHES, canvas
from learner.tools.sweep.outcomes import Curve


def draw(curves: Sequence[Curve], path: Path, rungs: Sequence[int] = ()) -> None:
    """The mean policy's return over rollouts: mean over the seeds, standard deviation shaded; an
    SVG file.

    A race has `rungs`: numbers of rollouts at which entries were dropped. Its axis is logarithmic,
    as they are.

    Raises:
      OSError: it cannot be written.
    """
    with canvas(path, 7.0, 4.2) as figure:
        axis = figure.subplots()
        for i, curve in enumerate(curves):
            colour = COLOURS[i % len(COLOURS)]
            dash = DASHES[i // len(COLOURS) % len(DASHES)]
            mean = np.nanmean(curve.returns, axis=0)
            deviation = np.nanstd(curve.returns, axis=0)
            axis.plot(curve.rollouts, mean, color=colour, linestyle=dash, lw=1.5, label=curve.label)
            axis.fill_between(
                curve.rollouts, mean - deviation, mean + deviation, color=colour, alpha=0.15, lw=0
            )
        axis.set(xlabel="rollouts", ylabel="return of the mean policy, nominal start")
        if rungs:
            axis.set_xscale("log")
            for rung in rungs:
                axis.axvline(rung, color="0.8", lw=0.8, zorder=0)
        if len(curves) > 1:
            axis.legend(fontsize=8, loc="best")
