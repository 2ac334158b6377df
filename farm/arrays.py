"""Array types for annotations, and fields of dataclasses that hold arrays."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]


def array(dtype: str, ndim: int, default: AnyArray | None = None) -> Any:  # noqa: ANN401  as dataclasses.field is typed
    """A dataclass field for an array of that dtype and number of dimensions; floats must be finite."""
    kind = {"dtype": np.dtype(dtype), "ndim": ndim}
    if default is None:
        return dataclasses.field(metadata=kind)
    return dataclasses.field(metadata=kind, default_factory=lambda: default)
