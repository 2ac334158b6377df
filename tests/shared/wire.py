"""What travels, packed by msgpack alone, so that a test can send what `farm.net.codec` would not;
and compared.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np


def ext(dtype: str, shape: Any, raw: bytes, code: int = 1) -> msgpack.ExtType:
    """An array as it travels: a header of known length, then its bytes."""
    head = msgpack.packb([dtype, shape])
    return msgpack.ExtType(code, bytes([len(head)]) + head + raw)


def pack(value: Any) -> bytes:
    """A message's bytes from its map."""

    def array(each: np.ndarray) -> msgpack.ExtType:
        return ext(each.dtype.str, each.shape, each.tobytes())

    return msgpack.packb(value, default=array)


def assert_same(one: Any, two: Any) -> None:
    """Of the same types, and the same to the last bit."""
    assert type(one) is type(two)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (two.dtype, two.shape)
        assert one.tobytes() == two.tobytes()
    elif isinstance(one, tuple):
        assert len(one) == len(two)
        for a, b in zip(one, two, strict=True):
            assert_same(a, b)
    elif isinstance(one, Mapping):
        assert list(one) == list(two)
        for name in one:
            assert_same(one[name], two[name])
    elif dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            assert_same(getattr(one, field.name), getattr(two, field.name))
    else:
        assert one == two
