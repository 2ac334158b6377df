"""Colours, and the curves of a run: their names, and a generation's values as Rerun entities."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray, IntArray
from farm.net.stats import Progress

Colour = tuple[int, int, int]

SKY: Final = (86, 180, 233)
GREEN: Final = (0, 158, 115)
PURPLE: Final = (204, 121, 167)
ORANGE: Final = (230, 159, 0)
YELLOW: Final = (240, 228, 66)
BLUE: Final = (0, 114, 178)
VERMILLION: Final = (213, 94, 0)
GREY: Final = (150, 150, 150)


_RAMP: Final = np.array(  # from dark violet over blue and green to yellow, alike in lightness to viridis
    [[68, 1, 84], [59, 81, 139], [33, 144, 141], [93, 200, 99], [253, 231, 37]], dtype=float
)


def lines(
    names: Sequence[str], colours: Iterable[Colour], width: float = 2.0, hidden: Sequence[str] = ()
) -> rr.SeriesLines:
    """Names and colours of an entity's curves; hidden ones are a click on the legend away."""
    return rr.SeriesLines(
        names=list(names),
        colors=list(colours),
        widths=[width] * len(names),
        visible_series=[name not in hidden for name in names],
    )


def ramp(values: FloatArray, top: float) -> IntArray:
    """Colours of values in [0, top], (...) -> (...) packed as 0xRRGGBBAA."""
    share = np.clip(values / top, 0.0, 1.0)
    knots = np.linspace(0.0, 1.0, len(_RAMP))
    rgb = [np.rint(np.interp(share, knots, channel)).astype(np.uint32) for channel in _RAMP.T]
    return rgb[0] << 24 | rgb[1] << 16 | rgb[2] << 8 | np.uint32(255)


def pack(colour: Colour) -> int:
    """A colour as 0xRRGGBBAA."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | 255


def static() -> list[tuple[str, Any]]:
    """Names and colours of the learning curves, in the order of `statistics`."""
    returns = ("mean", "min", "max", "best", "baseline", "mean policy")
    colours = (SKY, VERMILLION, GREEN, ORANGE, GREY, YELLOW)
    band = rr.Measurements.from_fields(names="mean ± std", colors=[SKY], widths=[2.0])
    return [
        ("/learning/return", lines(returns, colours, hidden=("mean", "min", "max"))),
        ("/learning/return_std", band),
        ("/learning/sigma", lines(("mean", "min", "max"), (SKY, BLUE, GREY), hidden=("max",))),
        ("/learning/mean_norm", lines(("norm of mu",), (SKY,))),
        ("/learning/success", lines(("exploring", "mean policy"), (SKY, YELLOW))),
        ("/learning/lost", lines(("dropped", "failed", "clamped"), (ORANGE, VERMILLION, GREY))),
        ("/farm/workers", lines(("workers",), (GREEN,))),
        ("/farm/rollouts_per_s", lines(("rollouts per s",), (SKY,))),
        ("/farm/reissued", lines(("reissued",), (ORANGE,))),
    ]


def statistics(progress: Progress, rate: float) -> list[tuple[str, Any]]:
    """A generation's values; rate is of exploring rollouts [1/s]."""
    p = progress
    baseline = np.nan if p.baseline is None else p.baseline
    success = []
    if p.success_rate is not None and p.mean_policy_success is not None:
        success.append(("/learning/success", rr.Scalars([p.success_rate, float(p.mean_policy_success)])))
    mean, spread = p.return_mean, (p.return_min, p.return_max)
    return [
        ("/learning/return", rr.Scalars([mean, *spread, p.best, baseline, p.mean_policy_return])),
        (
            "/learning/return_std",
            rr.Measurements.from_fields(values=[mean], variances=[p.return_std**2]),
        ),
        ("/learning/sigma", rr.Scalars([p.sigma_mean, p.sigma_min, p.sigma_max])),
        ("/learning/mean_norm", rr.Scalars([p.mean_norm])),
        *success,
        ("/learning/lost", rr.Scalars([p.dropped, p.failed, p.clamped])),
        ("/farm/workers", rr.Scalars([p.workers])),
        ("/farm/rollouts_per_s", rr.Scalars([rate])),
        ("/farm/reissued", rr.Scalars([p.reissued])),
    ]
