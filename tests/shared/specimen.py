"""A message with a field of every kind, and the map as which it travels."""

from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray, array
from farm.net import codec


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A part of a message."""

    number: int
    weight: float


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One field of every kind."""

    text: str
    count: int
    flag: bool
    value: float
    settings: dict[str, Any]
    numbers: tuple[int, ...]
    seed: tuple[int, ...] | None
    inner: Inner | None
    inners: tuple[Inner, ...]
    doubles: FloatArray = array("<f8", 2)
    singles: AnyArray = array("<f4", 1)
    whole: IntArray = array("<i8", 3)
    truths: BoolArray = array("|b1", 1)

    def __post_init__(self) -> None:
        """Refuse a negative count, and divide."""
        if self.count < 0:
            raise ValueError(f"a count of {self.count}")
        _ = 1 // (self.count - 99)


def sample(**changes: Any) -> Sample:
    """One with other values than these in some fields."""
    values = {
        "text": "grip äß",
        "count": 3,
        "flag": True,
        "value": -0.1,
        "settings": {"a": 1, "b": [1.5, "x", None], "c": {"d": False}},
        "numbers": (1, -1),
        "seed": (1, 2**63, 2**64 - 1),
        "inner": Inner(number=-5, weight=0.25),
        "inners": (Inner(number=1, weight=1.0), Inner(number=2, weight=5e-324)),
        "doubles": np.array([[0.1, -0.0], [5e-324, 1.7e308]]),
        "singles": np.array([0.1, 3e38], dtype="<f4"),
        "whole": np.arange(-4, 4).reshape(2, 2, 2),
        "truths": np.array([True, False, True]),
    }
    return Sample(**(values | changes))


def body(**changes: Any) -> dict[str, Any]:
    """Return the sample as the map that goes over the wire."""
    plain = msgpack.unpackb(codec.encode(sample()), ext_hook=msgpack.ExtType)
    return plain | changes
