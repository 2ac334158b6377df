"""PGPE's equations: the weight of each row of eps, the weighted sums over the rows, and the steps
of mu and sigma.

Shapes: P parameters; eps (R, P) and returns (R, 2) with columns (+, -) for pairs, (R, 1) for single
rollouts. Sums run over the rows in index order and never through BLAS, norms are plain sums, so the
bits do not depend on the number of threads. Steps ascend; the memory of ClipUp and Adam, (P,), is
an argument and a result.
"""

from typing import Literal, TypeAlias

import numpy as np

from farm.arrays import FloatArray

Normaliser: TypeAlias = Literal["sehnke", "thesis"]
SigmaRule: TypeAlias = Literal["positive", "capped", "bare"]

_ROUNDING = 1e-12
_ADAM_EPSILON = 1e-8


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
    """r_T, the weight of a pair in the step of mu: (N, 2) -> (N,) (Sehnke 2010, algorithm 1,
    symmetric).

    sehnke: (r+ - r-) / (2m - r+ - r-), from ((r+ - r-)/2) / (m - (r+ + r-)/2) as in the authors'
    code: within [-1, 1], and unchanged when all returns are shifted or scaled.
    thesis: (r+ - r-) / (m - r+ - r-), as printed by Plage 2016, algorithm 1. The print lacks a
    factor 2: its sign flips where r+ + r- exceeds m; negative returns happen to avoid that.

    The weight is 0 if r+ = r- or if the denominator is 0.
    """
    plus, minus = returns[:, 0], returns[:, 1]
    # 2m - r+ - r- in the order that keeps |r_T| <= 1 in floating point too.
    below = (best - plus) + (best - minus) if normaliser == "sehnke" else best - plus - minus
    return _quotient(plus - minus, below)


def baseline_contrast(middle: FloatArray, baseline: float, best: float) -> FloatArray:
    """r_S = (r - b) / |m - b|, the weight of a row in the step of sigma: (R,) -> (R,).

    Sehnke 2010, algorithm 1. A baseline computed from returns has m >= b. Without a baseline, b =
    0, negative returns would make m - b negative and so favour the worst; hence |m - b|. The weight
    is 0 if m = b.
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
    """Whether m = b up to the rounding of b; then (r - b) / (m - b) would be noise."""
    return abs(best - baseline) <= _ROUNDING * max(abs(best), abs(baseline))


def _quotient(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Divide; the result is 0 if numerator or denominator is 0."""
    mask = (numerator != 0.0) & (denominator != 0.0)
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=mask)


def optimal_baseline(middle: FloatArray, eps: FloatArray, sigma: FloatArray) -> float:
    """b* = sum r_n g_n / sum g_n, the baseline of least variance (Zhao 2011).

    g_n = |grad_(mu, sigma) log p(theta_n)|^2 with grad_mu = eps/sigma^2 and grad_sigma =
    (eps^2 - sigma^2)/sigma^3, here in z = eps/sigma: sum_i (z_i^2 + (z_i^2 - 1)^2) / sigma_i^2.
    Both rollouts of a pair have the same g, so the pair enters with its mean return.
    """
    square = (eps / sigma) ** 2
    weights = ((square + (square - 1.0) ** 2) / (sigma * sigma)).sum(axis=1)
    total = float(weights.sum())  # positive: z^2 and (z^2 - 1)^2 are never both 0
    return float((middle * weights).sum()) / total


def centred_ranks(returns: FloatArray) -> FloatArray:
    """Replace every return by its rank, over all rollouts, spread evenly over [-0.5, 0.5].

    Equal returns get the mean of their ranks, so they do not differ. Any shape; returns the same
    shape.
    """
    shared = (_ranks(returns.ravel()) - 1.0) / (returns.size - 1) - 0.5
    return shared.reshape(returns.shape)


def signed_ranks(returns: FloatArray) -> FloatArray:
    """Replace each pair's difference r+ - r- by its sign times the rank of its size among all
    pairs: (N, 2) -> (N,), within [-1, 1] (Wilcoxon 1945).

    Equal sizes get the mean of their ranks; a difference of 0 stays 0.
    """
    difference = returns[:, 0] - returns[:, 1]
    return np.sign(difference) * _ranks(np.abs(difference)) / len(difference)


def _ranks(values: FloatArray) -> FloatArray:
    """Ranks of values (n,) from 1 on; equal values get the mean of their ranks."""
    _, where, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2.0
    return ranks[where]


def _norm(vector: FloatArray) -> float:
    """Euclidean norm, scaled by the largest entry so that its squares cannot overflow."""
    largest = float(np.abs(vector).max())
    if largest == 0.0:
        return 0.0
    scaled = vector / largest
    return largest * float(np.sqrt((scaled * scaled).sum()))


def clipup(
    gradient: FloatArray,
    velocity: FloatArray,
    *,
    learning_rate: float,
    momentum: float,
    max_speed: float,
) -> FloatArray:
    """Return ClipUp's next velocity, which is also the step of mu (Toklu 2020, algorithm 1).

    Only the direction of the gradient counts: v <- momentum v + learning_rate g/|g|, then v is
    shortened to `max_speed`. A zero gradient has no direction and adds nothing.
    """
    length = _norm(gradient)
    pushed = momentum * velocity
    if length != 0.0:
        pushed = pushed + learning_rate * (gradient / length)
    speed = _norm(pushed)
    return pushed * (max_speed / speed) if speed > max_speed else pushed


def adam(
    gradient: FloatArray,
    moments: tuple[FloatArray, FloatArray],
    *,
    count: int,
    learning_rate: float,
    decays: tuple[float, float],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Adam's step and its two moments (Kingma & Ba 2015, algorithm 1); `count` starts at
    1.
    """
    first = decays[0] * moments[0] + (1.0 - decays[0]) * gradient
    second = decays[1] * moments[1] + (1.0 - decays[1]) * (gradient * gradient)
    mean = first / (1.0 - decays[0] ** count)
    square = second / (1.0 - decays[1] ** count)
    return learning_rate * mean / (np.sqrt(square) + _ADAM_EPSILON), first, second


def step_sigma(
    sigma: FloatArray, step: FloatArray, rule: SigmaRule, *, cap: float, floor: float
) -> FloatArray:
    """Add a step to sigma; `capped` limits it to cap * sigma.

    The result is never below the floor.
    """
    if rule == "capped":
        step = np.clip(step, -cap * sigma, cap * sigma)
    return np.maximum(sigma + step, floor)
