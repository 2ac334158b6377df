"""Array types for annotations, fields of dataclasses that hold arrays, and the check of a shape."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from farm.errors import TaskError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]


def array(dtype: str, ndim: int, default: AnyArray | None = None) -> Any:  # noqa: ANN401  as dataclasses.field is typed
    """A dataclass field for an array of that dtype and number of dimensions; floats must be
    finite.
    """
    kind = {"dtype": np.dtype(dtype), "ndim": ndim}
    if default is None:
        return dataclasses.field(metadata=kind)
    return dataclasses.field(metadata=kind, default_factory=lambda: default)


def shaped(name: str, values: Any, shape: tuple[int, ...]) -> AnyArray:  # noqa: ANN401  a task's result
    """Return the values if they are an array of this shape.

    Raises:
      TaskError: they are not; names the array, its shape and the expected one.
    """
    if not isinstance(values, np.ndarray) or values.shape != shape:
        got = (
            f"an array of shape {values.shape}"
            if isinstance(values, np.ndarray)
            else f"a {type(values).__name__}"
        )
        raise TaskError(f"{name} gave {got}; expected an array of shape {shape}")
    if values.dtype.kind not in "biuf":
        raise TaskError(f"{name} gave an array of {values.dtype}; expected real numbers")
    return values
