"""Shapes of learning curves: when a return rises, how far it drops, and whether it recovers.

Pure.
"""

import numpy as np

from benchmarks.thesis.series import Series
from farm.arrays import BoolArray, FloatArray

END_OF_START = 5
"""Number of generations that count as the start of a run."""


def about(values: FloatArray, low: float, high: float) -> bool:
    """Whether most trials have a value and their median is within these bounds."""
    numbers = values[~np.isnan(values)]
    return len(numbers) > len(values) / 2 and bool(low <= np.median(numbers) <= high)


def _smoothed(row: FloatArray) -> FloatArray:
    """Mean over five generations; nan near the ends."""
    out = np.full(len(row), np.nan)
    numbers = row[~np.isnan(row)]
    if len(numbers) < 5:
        out[: len(numbers)] = numbers
    else:
        out[2 : len(numbers) - 2] = np.convolve(numbers, np.ones(5) / 5, "valid")
    return out


def first_and_best(series: Series) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Smoothed returns (trials, generations).

    Each trial's mean return at its start, and its best.
    """
    returns = series.columns["return_mean"]
    smooth = np.stack([_smoothed(row) for row in returns])
    return smooth, np.nanmean(returns[:, :END_OF_START], axis=1), np.nanmax(smooth, axis=1)


def rise(series: Series) -> FloatArray:
    """(trials,) generation at which the return is half way from its start to its best.

    nan if the best return does not exceed the start by a quarter of |start|.
    """
    smooth, first, best = first_and_best(series)
    at = [
        1 + np.argmax(row >= f + 0.5 * (b - f))
        for row, f, b in zip(smooth, first, best, strict=True)
    ]
    return np.where(best - first > 0.25 * np.abs(first), np.array(at, dtype=float), np.nan)


def largest_drop(series: Series) -> FloatArray:
    """(trials,) the largest drop of the smoothed return within 10 generations."""
    out = []
    for row in first_and_best(series)[0]:
        numbers = row[~np.isnan(row)]
        out.append(max(float(numbers[i] - numbers[i : i + 10].min()) for i in range(len(numbers))))
    return np.array(out)


def fallen(series: Series) -> BoolArray:
    """(trials,) whether the return ended below its start, and below its best by more than half of
    |start|.
    """
    _, first, best = first_and_best(series)
    return np.asarray(
        best - series.end("return_mean") > np.maximum(best - first, 0.5 * np.abs(first))
    )
