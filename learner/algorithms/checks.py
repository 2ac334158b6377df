"""The check of what comes into an algorithm; each failure is one ValueError that names the value."""

from __future__ import annotations

import numpy as np

from farm.arrays import FloatArray


def finite_rows(name: str, array: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the array in C order, so that sums over its rows run in index order."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has non-finite values, expected finite ones everywhere")
    return array
