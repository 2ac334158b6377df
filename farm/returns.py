"""Returns of rollouts, some of which have none because they failed. Pure."""

from typing import Final

import numpy as np

from farm.arrays import BoolArray, FloatArray

RETURN_FLOOR: Final = -1e12
"""Stands in results for the return of a rollout that failed or whose return overflowed; never
part of a mean.
"""


def known(returns: FloatArray) -> BoolArray:
    """Which rollouts have a return, of the returns' shape."""
    return returns > RETURN_FLOOR


def penalised(returns: FloatArray) -> FloatArray:
    """Returns for learning and judging: a failed rollout ranks last and sets no scale.

    Its return becomes the worst one of the others, less their standard deviation; less the size of
    the worst one, or 1, if all others are equal. Without any return they are all equal, and stay as
    they are.

    Args:
      returns: of the rollouts that are compared with each other, any shape.

    Returns:
      a new array of the same shape.
    """
    mask = known(returns)
    if mask.all() or not mask.any():
        return returns.copy()
    others = returns[mask]
    worst = float(others.min())
    equal = worst == float(others.max())  # their standard deviation may be a rounding error
    spread = max(abs(worst), 1.0) if equal else float(others.std())
    return np.where(mask, returns, worst - spread)


def mean(returns: FloatArray) -> float | None:
    """Mean over the rollouts that have a return; None if none has."""
    mask = known(returns)
    return float(returns[mask].mean()) if mask.any() else None
