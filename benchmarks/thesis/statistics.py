"""Whether trials of two set-ups differ by more than chance.

Pure; no assumption about the distribution of returns.
"""

from typing import Final, Literal

import numpy as np
from scipy import stats

from farm.arrays import FloatArray

LEVEL: Final = 0.05
"""Probability of a wrong yes, and of a wrong no."""

NEAR: Final = 0.5
"""Returns that differ by less count as equal: a tenth of the way from holding still (-5.4) to the
gait (-0.07).
"""

_DRAWS: Final = 100_000
"""Up to this number of ways to divide the trials all are tried (5 and 5 have 252); of more, as
many are drawn.
"""

Answer = bool | Literal["undecided"]


def above(first: FloatArray, second: FloatArray) -> tuple[Answer, float]:
    """Whether the mean of `first` (n,) is above that of `second` (m,), by permutation tests (Fisher
    1935).

    Returns:
      True if it is, False if it is below, undecided if neither is beyond chance (LEVEL, one-sided);
      and the probability p of a difference as large as this one, if which trial has which set-up
      did not matter.
    """
    p, opposite = (_permuted(first, second, direction) for direction in ("greater", "less"))
    return True if p <= LEVEL else False if opposite <= LEVEL else "undecided", p


def all_above(*pairs: tuple[FloatArray, FloatArray]) -> tuple[Answer, float]:
    """Whether `above` is true of every pair; no if it is false of one; p is the largest."""
    results = [above(*pair) for pair in pairs]
    answers, p = {answer for answer, _ in results}, max(p for _, p in results)
    return False if False in answers else "undecided" if "undecided" in answers else True, p


def less_spread(first: FloatArray, second: FloatArray) -> tuple[Answer, float]:
    """Whether trials of `first` are closer to their median than those of `second` to theirs (Brown
    & Forsythe 1974).
    """
    return above(*(np.abs(values - np.nanmedian(values)) for values in (second, first)))


def difference(first: FloatArray, second: FloatArray) -> tuple[float, float]:
    """The 95 % interval of the difference of means, first - second: percentile bootstrap (Efron
    1979).
    """
    rng, sums = np.random.default_rng(0), []
    for values in map(_known, (first, second)):
        sums.append(rng.choice(values, (_DRAWS // 10, len(values))).mean(axis=1))
    low, high = np.quantile(sums[0] - sums[1], [0.025, 0.975])
    return float(low), float(high)


def share(count: int, trials: int) -> tuple[float, float]:
    """The 95 % interval of a probability, from `count` of `trials` (Clopper & Pearson 1934)."""
    interval = stats.binomtest(count, trials).proportion_ci(method="exact")
    return float(interval.low), float(interval.high)


def _known(values: FloatArray) -> FloatArray:
    return values[~np.isnan(values)]


def _permuted(first: FloatArray, second: FloatArray, alternative: str) -> float:
    samples = _known(first), _known(second)
    if min(map(len, samples)) < 2:  # one trial shows nothing
        return 1.0
    result = stats.permutation_test(
        samples,
        _means,
        vectorized=True,
        n_resamples=_DRAWS,
        alternative=alternative,
        rng=np.random.default_rng(0),
        batch=1000,
    )
    return float(result.pvalue)


def _means(first: FloatArray, second: FloatArray, axis: int) -> FloatArray:
    return np.asarray(first.mean(axis=axis) - second.mean(axis=axis))
