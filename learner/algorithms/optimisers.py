"""Steps of mu (ClipUp, Adam) and sigma (three rules) along a gradient; all of them ascend.

Shapes: every array is (P,). Pure functions: their memory is an argument and a result. Norms are
plain sums, because the order of sums in BLAS may depend on the number of threads.
"""

from typing import Literal, TypeAlias

import numpy as np

from farm.arrays import FloatArray

SigmaRule: TypeAlias = Literal["positive", "capped", "bare"]

_ADAM_EPSILON = 1e-8


def _norm(vector: FloatArray) -> float:
    """Euclidean norm, scaled by the largest entry so that its squares cannot overflow."""
    largest = float(np.abs(vector).max())
    if largest == 0.0:
        return 0.0
    scaled = vector / largest
    return largest * float(np.sqrt((scaled * scaled).sum()))


def clipup(
    gradient: FloatArray, velocity: FloatArray, *, learning_rate: float, momentum: float, max_speed: float
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
    """Return Adam's step and its two moments (Kingma & Ba 2015, algorithm 1); `count` starts at 1."""
    first = decays[0] * moments[0] + (1.0 - decays[0]) * gradient
    second = decays[1] * moments[1] + (1.0 - decays[1]) * (gradient * gradient)
    mean = first / (1.0 - decays[0] ** count)
    square = second / (1.0 - decays[1] ** count)
    return learning_rate * mean / (np.sqrt(square) + _ADAM_EPSILON), first, second


def step_sigma(sigma: FloatArray, step: FloatArray, rule: SigmaRule, *, cap: float, floor: float) -> FloatArray:
    """Add a step to sigma; `capped` limits it to cap * sigma. The result is never below the floor."""
    if rule == "capped":
        step = np.clip(step, -cap * sigma, cap * sigma)
    return np.maximum(sigma + step, floor)
