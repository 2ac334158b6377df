"""What travels, packed by msgpack alone, so that a test can send what `farm.net.codec` would not."""

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
