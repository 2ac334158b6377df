"""PGPE's equations: how much each row of eps counts, and the weighted sums over the rows.

Shapes: P parameters; eps (R, P) and returns (R, 2) with columns (+, -) for pairs, (R, 1) for
single rollouts. Sums run over the rows in index order and never through BLAS, so the same results
give the same bits on any number of threads.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from farm.arrays import FloatArray

Normaliser: TypeAlias = Literal["sehnke", "thesis"]

_ROUNDING = 1e-12


def weighted_sum(factors: FloatArray, rows: FloatArray) -> FloatArray:
    """Sum factors[n] * rows[n] over n: (R,), (R, P) -> (P,)."""
    return (factors[:, None] * rows).sum(axis=0)


def sigma_characteristic(eps: FloatArray, sigma: FloatArray) -> FloatArray:
    """S = (eps^2 - sigma^2) / sigma, (R, P) (Sehnke 2010, algorithm 1)."""
    return (eps * eps - sigma * sigma) / sigma


def middle_returns(returns: FloatArray) -> FloatArray:
    """A row's mean return, (R,): (r+ + r-)/2 of a pair, r of a single rollout."""
    if returns.shape[1] == 1:
        return returns[:, 0]
    return (returns[:, 0] + returns[:, 1]) / 2.0


def pair_contrast(returns: FloatArray, best: float, normaliser: Normaliser) -> FloatArray:
    """r_T, what a pair says about mu: (N, 2) -> (N,) (Sehnke 2010, algorithm 1, symmetric).

    sehnke: (r+ - r-) / (2m - r+ - r-). Derived from ((r+ - r-)/2) / (m - (r+ + r-)/2), as the
    authors' own code has it: within [-1, 1], the same when all returns are shifted or scaled.
    thesis: (r+ - r-) / (m - r+ - r-), as printed by Plage 2016, algorithm 1. The print lacks a
    factor 2: its sign turns where r+ + r- passes m, which negative returns happen to avoid.

    r+ = r- moves nothing, nor does a vanishing denominator.
    """
    plus, minus = returns[:, 0], returns[:, 1]
    # 2m - r+ - r- in the order that keeps |r_T| <= 1 in floating point too.
    below = (best - plus) + (best - minus) if normaliser == "sehnke" else best - plus - minus
    return _quotient(plus - minus, below)


def baseline_contrast(middle: FloatArray, baseline: float, best: float) -> FloatArray:
    """r_S = (r - b) / (m - b), what a row says about sigma: (R,) -> (R,).

    Sehnke 2010, algorithm 1. A baseline made of returns has m >= b. Without one, b = 0, negative
    returns would make m - b negative and so favour the worst; hence its size. m = b moves nothing.
    """
    if level(best, baseline):
        return np.zeros_like(middle)
    return (middle - baseline) / abs(best - baseline)


def plain_contrast(middle: FloatArray, baseline: float) -> FloatArray:
    """Return r - b, (R,), in units of the returns (Plage 2016, eq. 3.1)."""
    above = middle - baseline
    above[np.abs(above) <= _ROUNDING * abs(baseline)] = 0.0  # equal but for the rounding of b
    return above


def level(best: float, baseline: float) -> bool:
    """Whether m = b up to the rounding of b; then (r - b) / (m - b) would be only noise."""
    return abs(best - baseline) <= _ROUNDING * max(abs(best), abs(baseline))


def _quotient(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Divide; the result is 0 if either vanishes."""
    wanted = (numerator != 0.0) & (denominator != 0.0)
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=wanted)


def optimal_baseline(middle: FloatArray, eps: FloatArray, sigma: FloatArray) -> float:
    """b* = sum r_n g_n / sum g_n, the baseline of least variance (Zhao 2011).

    g_n = |grad_(mu, sigma) log p(theta_n)|^2 with grad_mu = eps/sigma^2 and grad_sigma =
    (eps^2 - sigma^2)/sigma^3, here in z = eps/sigma: sum_i (z_i^2 + (z_i^2 - 1)^2) / sigma_i^2.
    Both rollouts of a pair have the same g, so its mean return stands for both.
    """
    square = (eps / sigma) ** 2
    weights = ((square + (square - 1.0) ** 2) / (sigma * sigma)).sum(axis=1)
    total = float(weights.sum())  # positive: z = 0 and z = 1 do not meet
    return float((middle * weights).sum()) / total


def centred_ranks(returns: FloatArray) -> FloatArray:
    """Replace every return by its rank, over all rollouts, spread evenly over [-0.5, 0.5].

    Equal returns share the mean of their ranks, so they have no contrast. Any shape; the same out.
    """
    _, where, counts = np.unique(returns.ravel(), return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - counts + (counts - 1) / 2.0
    shared = ranks[where.ravel()] / (returns.size - 1) - 0.5
    return shared.reshape(returns.shape)
