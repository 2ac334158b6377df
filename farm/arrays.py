"""Names for array types, for annotations; and a check of values that is quick for few."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]

_FEW: Final = 100  # values: with fewer, Python is quicker than NumPy


def within(values: IntArray, least: int, end: int) -> bool:
    """Whether all are at least `least` and below `end`."""
    if values.size < _FEW:
        listed = values.ravel().tolist()
        return not listed or (min(listed) >= least and max(listed) < end)
    return bool(values.min() >= least and values.max() < end)
