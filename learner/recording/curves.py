"""Colours, and the curves of a run: their names, and the values of its generations as Rerun
entities.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray, IntArray
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report
from farm.sim.channels import Measure

Colour = tuple[int, int, int]

SKY: Final = (86, 180, 233)
GREEN: Final = (0, 158, 115)
PURPLE: Final = (204, 121, 167)
ORANGE: Final = (230, 159, 0)
YELLOW: Final = (240, 228, 66)
BLUE: Final = (0, 114, 178)
VERMILLION: Final = (213, 94, 0)
GREY: Final = (150, 150, 150)

PALETTE: Final = (SKY, ORANGE, GREEN, PURPLE, YELLOW, VERMILLION, BLUE)
"""Default colours, by Okabe and Ito."""

# From dark violet over blue and green to yellow, alike in lightness to viridis
_RAMP: Final = np.array(
    [[68, 1, 84], [59, 81, 139], [33, 144, 141], [93, 200, 99], [253, 231, 37]], dtype=float
)


@dataclass(frozen=True)
class Columns:
    """Rows of one entity, to be sent together."""

    entity: str
    columns: rr.ComponentColumnList
    rows: IntArray | None = None
    """Which frames, or generations, the rows belong to; None: all of them."""


def scalars(values: FloatArray) -> rr.ComponentColumnList:
    """Curves (F, n) as columns."""
    count, width = values.shape
    return rr.Scalars.columns(scalars=values.reshape(-1)).partition(np.full(count, width))


def palette(count: int) -> list[Colour]:
    """Colours, this number of them; they repeat after seven."""
    return list(islice(cycle(PALETTE), count))


def lighter(colour: Colour) -> Colour:
    """A colour halfway to white."""
    red, green, blue = ((255 + part) // 2 for part in colour)
    return red, green, blue


def lines(
    names: Sequence[str],
    colours: Iterable[Colour] | None = None,
    width: float = 2.0,
    hidden: Sequence[str] = (),
) -> rr.SeriesLines:
    """Names and colours of an entity's curves; hidden ones are a click on the legend away."""
    return rr.SeriesLines(
        names=list(names),
        colors=palette(len(names)) if colours is None else list(colours),
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


_MEAN_POLICY: Final = lines(("mean policy",), (ORANGE,))
_VALIDATION: Final = lines(("validation",), (PURPLE,))
_CURVES: Final[
    Sequence[tuple[str, rr.SeriesLines, Callable[[GenerationStats, float], list[float | None]]]]
] = (
    (
        "/learning/return",
        lines(("mean", "min", "max"), (SKY, VERMILLION, YELLOW)),
        lambda s, _: [s.return_mean, s.return_min, s.return_max],
    ),
    (
        "/learning/best",
        lines(("best", "baseline"), (GREEN, GREY)),
        lambda s, _: [s.best, s.baseline],
    ),
    (
        "/learning/sigma",
        lines(("mean", "min", "max"), (SKY, BLUE, GREY), hidden=("max",)),
        # The mean of equal numbers may be rounded, and that would be all that the plot shows.
        lambda s, _: [
            min(max(s.sigma_mean, s.sigma_min), s.sigma_max),
            s.sigma_min,
            s.sigma_max,
        ],
    ),
    ("/learning/mean_norm", lines(("norm of mu",), (SKY,)), lambda s, _: [s.mean_norm]),
    (
        "/learning/lost",
        lines(("ended early", "failed", "clamped"), (ORANGE, VERMILLION, GREY)),
        lambda s, _: [s.ended, s.failed, s.clamped],
    ),
    ("/farm/workers", lines(("workers",), (GREEN,)), lambda s, _: [s.workers]),
    ("/farm/rollouts_per_s", lines(("rollouts per s",), (SKY,)), lambda _, rate: [rate]),
    ("/farm/reissued", lines(("reissued",), (ORANGE,)), lambda s, _: [s.reissued]),
)
"""Curves of every run: entity, names and colours, and a generation's values, of its statistics and
rate [1/s].
"""


def static(*, success: bool, measures: Sequence[Measure] = ()) -> list[tuple[str, Any]]:
    """Names and colours of the learning curves.

    With success if the task defines it, and with its measures.
    """
    band = rr.Measurements.from_fields(names="mean ± std", colors=[SKY], widths=[2.0])
    entities: list[tuple[str, Any]] = [
        ("/learning/return_std", band),
        ("/learning/mean_policy/return", _MEAN_POLICY),
        ("/learning/mean_policy/validation", _VALIDATION),
    ]
    if success:
        entities += [
            ("/learning/success", lines(("exploring",), (SKY,))),
            ("/learning/mean_policy/success", _MEAN_POLICY),
        ]
    for each in measures:
        entities += [(f"/learning/measures/{each.name}", lines(("exploring",), (SKY,)))]
        entities += [(f"/learning/mean_policy/measures/{each.name}", _MEAN_POLICY)]
    return entities + [(entity, names) for entity, names, _ in _CURVES]


def statistics(reports: Sequence[Report]) -> Iterator[Columns]:
    """Curves of some generations' exploring rollouts."""
    stats = [report.progress for report in reports]
    yield Columns("/learning/return_std", band(stats))
    yield from _known("/learning/success", [each.success_rate for each in stats])
    yield from _measures("/learning/measures", [each.measures for each in stats])
    for entity, _, values in _CURVES:
        yield Columns(
            entity,
            scalars(np.array([values(each.progress, each.rate) for each in reports], dtype=float)),
        )


def band(stats: Sequence[GenerationStats]) -> rr.ComponentColumnList:
    """Mean and spread of the returns of each generation; a gap where all rollouts failed."""
    means = numbers([each.return_mean for each in stats])
    return rr.Measurements.columns(
        values=means, variances=numbers([each.return_std for each in stats]) ** 2
    )


def numbers(values: Sequence[float | None]) -> FloatArray:
    """Values (n,) in which unknown ones are nan: a gap of a curve."""
    return np.array(values, dtype=float)


def mean_policies(stats: Sequence[GenerationStats]) -> Iterator[Columns]:
    """Curves of the mean policies of some generations: returns, measures, and success if the task
    defines it.
    """
    yield from _known("/learning/mean_policy/return", [each.mean_policy_return for each in stats])
    yield from _known("/learning/mean_policy/validation", [each.validation for each in stats])
    yield from _known("/learning/mean_policy/success", [each.mean_policy_success for each in stats])
    yield from _measures(
        "/learning/mean_policy/measures", [each.mean_policy_measures for each in stats]
    )


def last_policy(value: float | None, success: bool | None) -> Iterator[Columns]:
    """Return and success of a finished run's last policy; no return if it failed."""
    yield from _known("/learning/mean_policy/return", [value])
    yield from _known("/learning/mean_policy/success", [success])


def _measures(entity: str, several: Sequence[Mapping[str, float | None]]) -> Iterator[Columns]:
    """Curves of measures, by name; a gap where all rollouts failed."""
    for name in several[0]:
        yield from _known(f"{entity}/{name}", [each.get(name) for each in several])


def _known(entity: str, values: Sequence[float | None]) -> Iterator[Columns]:
    """A curve of those values that are known."""
    rows = [row for row, value in enumerate(values) if value is not None]
    if rows:
        yield Columns(
            entity, scalars(np.array([[values[row]] for row in rows], dtype=float)), np.array(rows)
        )
