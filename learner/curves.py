"""Curves of a run as Rerun entities: their names and colours, and a generation's values."""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import rerun as rr

from learner.progress import Progress

Colour = tuple[int, int, int]

SKY: Final = (86, 180, 233)
GREEN: Final = (0, 158, 115)
PURPLE: Final = (204, 121, 167)
ORANGE: Final = (230, 159, 0)
YELLOW: Final = (240, 228, 66)
BLUE: Final = (0, 114, 178)
VERMILLION: Final = (213, 94, 0)
GREY: Final = (150, 150, 150)

def lines(names: Iterable[str], colours: Iterable[Colour], width: float = 2.0, hidden: int = 0) -> rr.SeriesLines:
    """Names and colours of an entity's curves; the last `hidden` are switched off until asked for."""
    names = list(names)
    shown = [i < len(names) - hidden for i in range(len(names))]
    return rr.SeriesLines(
        names=names, colors=list(colours), widths=[width] * len(names), visible_series=shown
    )


def static() -> list[tuple[str, Any]]:
    """Names and colours of the learning curves."""
    returns = ("best", "baseline", "mean policy", "mean", "min", "max")
    return [
        (
            "/learning/return",
            lines(returns, [ORANGE, GREY, YELLOW, SKY, VERMILLION, GREEN], hidden=3),
        ),
        (
            "/learning/return_std",
            rr.Measurements.from_fields(names="mean ± standard deviation", colors=[SKY], widths=[2.0]),
        ),
        ("/learning/sigma", lines(("mean", "min", "max"), [SKY, BLUE, GREY])),
        ("/learning/mean_norm", lines(["norm"], [SKY])),
        ("/learning/success", lines(("exploring rollouts", "mean policy"), [SKY, YELLOW])),
        ("/learning/lost", lines(("dropped", "failed", "clamped"), [ORANGE, VERMILLION, GREY])),
        ("/farm/workers", lines(["workers"], [GREEN])),
        ("/farm/rollouts_per_s", lines(["rollouts a second"], [SKY])),
        ("/farm/reissued", lines(["jobs given out again"], [ORANGE])),
    ]


def statistics(p: Progress, rate: float) -> list[tuple[str, Any]]:
    baseline = np.nan if p.baseline is None else p.baseline
    returns = [p.best, baseline, p.mean_policy_return, p.return_mean, p.return_min, p.return_max]
    band = rr.Measurements.from_fields(values=[p.return_mean], variances=[p.return_std**2])
    return [
        ("/learning/return", rr.Scalars(returns)),
        ("/learning/return_std", band),
        ("/learning/sigma", rr.Scalars([p.sigma_mean, p.sigma_min, p.sigma_max])),
        ("/learning/mean_norm", rr.Scalars([p.mean_norm])),
        ("/learning/success", rr.Scalars([p.success_rate, float(p.mean_policy_success)])),
        ("/learning/lost", rr.Scalars([p.dropped, p.failed, p.clamped])),
        ("/farm/workers", rr.Scalars([p.workers])),
        ("/farm/rollouts_per_s", rr.Scalars([rate])),
        ("/farm/reissued", rr.Scalars([p.reissued])),
    ]
