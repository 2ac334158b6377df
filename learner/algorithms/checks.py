"""Checks of what comes into an algorithm; each failure is one ValueError that names the value."""

from __future__ import annotations

import math

import numpy as np

from farm.arrays import FloatArray


def check_number(name: str, value: object, bounds: tuple[float, float], expected: str) -> None:
    """Refuse what is no finite number within the closed bounds; `expected` says them in words."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} is {value!r}, expected a finite number, {expected}")
    if not bounds[0] <= value <= bounds[1]:
        raise ValueError(f"{name} is {value!r}, expected {expected}")


def check_count(name: str, value: object) -> None:
    """Refuse what is no integer of 1 or more."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} is {value!r}, expected an integer of 1 or more")


def finite_rows(name: str, array: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the array in C order, so that sums over its rows run in index order."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has non-finite values, expected finite ones everywhere")
    return array
