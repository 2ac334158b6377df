"""Dataclasses to bytes and back, checked; the only door to msgpack.

Structure is msgpack; an array is an extension of dtype, shape and raw bytes. What a field may
hold follows from its annotation; arrays say dtype and number of dimensions by `array(...)`.
Decoding never raises anything but MessageError, whatever the bytes.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Final, TypeVar

import msgpack
import numpy as np

from farm.arrays import AnyArray
from farm.errors import MessageError

SCHEMA: Final = 1
"""Version of everything on the wire; stands in every message."""

MAX_BYTES: Final = 64 * 1024 * 1024
"""Larger messages are refused unread."""

_ARRAY: Final = 1  # msgpack's extension code
_DTYPES: Final = ("<f8", "<f4", "<i8", "|b1")
_LISTS: Final = 100_000

M = TypeVar("M")


def array(dtype: str, ndim: int) -> Any:  # noqa: ANN401  a dataclass field, as dataclasses.field is typed
    """A dataclass field for an array of that dtype and number of dimensions; floats must be finite."""
    return dataclasses.field(metadata={"dtype": dtype, "ndim": ndim})


def encode(message: object) -> bytes:
    """The message with its type's name and the schema version."""
    body = {"schema": SCHEMA, "type": type(message).__name__, **_plain(message)}
    return bytes(msgpack.packb(body, default=_pack, use_bin_type=True) or b"")


def decode(payload: bytes, kind: type[M]) -> M:
    """The message of that type in these bytes.

    Raises:
      MessageError: oversized ("large"), not msgpack or of the wrong shape ("bad"), another type
        ("bad") or another schema version ("version").
    """
    if len(payload) > MAX_BYTES:
        raise MessageError(f"a message of {len(payload)} bytes; at most {MAX_BYTES} are taken", "large")
    try:
        structure = msgpack.Unpacker(max_buffer_size=max(len(payload), 1))
        structure.feed(payload)
        structure.skip()  # every length it announces is there: nothing is allocated for a promise
        body = msgpack.unpackb(payload, ext_hook=_unpack, strict_map_key=True, max_array_len=_LISTS, max_map_len=_LISTS)
    except MessageError:
        raise
    except Exception as error:  # msgpack and its hooks raise many kinds
        raise MessageError(f"not a message: {error}") from None
    if not isinstance(body, dict):
        raise MessageError(f"not a message: a {type(body).__name__}")
    schema, name = body.get("schema"), body.get("type")
    if type(schema) is not int or schema != SCHEMA:
        raise MessageError(
            f"schema version {_brief(schema)}, this side speaks {SCHEMA}: run the same release on both", "version"
        )
    if type(name) is not str or name != kind.__name__:
        raise MessageError(f"a {_brief(name)} where a {kind.__name__} was expected")
    try:
        return typing.cast("M", _build(kind, body, {"schema", "type"}))
    except RecursionError:
        raise MessageError("nested too deeply") from None


def _plain(value: Any) -> dict[str, Any]:  # noqa: ANN401
    return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}


def _pack(value: object) -> object:
    if isinstance(value, np.ndarray):
        head = bytes(msgpack.packb([value.dtype.str, list(value.shape)]) or b"")
        return msgpack.ExtType(_ARRAY, head + np.ascontiguousarray(value).tobytes())
    if dataclasses.is_dataclass(value):
        return _plain(value)
    raise TypeError(f"cannot send a {type(value).__name__}")


def _unpack(code: int, payload: bytes) -> AnyArray:
    if code != _ARRAY:
        raise MessageError(f"unknown extension {code}")
    unpacker = msgpack.Unpacker(max_array_len=16, max_buffer_size=200)
    unpacker.feed(payload[:200])
    dtype, shape = unpacker.unpack()
    if dtype not in _DTYPES or not all(type(n) is int and 0 <= n <= MAX_BYTES for n in shape) or len(shape) > 4:
        raise MessageError("an array of an unknown kind")
    raw = memoryview(payload)[unpacker.tell() :]
    if math.prod(shape) * np.dtype(dtype).itemsize != len(raw):
        raise MessageError(f"an array of shape {tuple(shape)} in {len(raw)} bytes")
    return np.frombuffer(raw, dtype=dtype).reshape(shape)


def _build(kind: type, value: object, extra: set[str] | None = None) -> object:
    """A dataclass from a map, every field checked."""
    if not isinstance(value, dict):
        raise MessageError(f"a {type(value).__name__} where a {kind.__name__} was expected")
    fields = _fields(kind)
    unknown = value.keys() - fields.keys() - (extra or set())
    missing = fields.keys() - value.keys()
    if unknown or missing:
        names = ", ".join(sorted(str(name)[:40] for name in unknown | missing))
        raise MessageError(f"{kind.__name__}: unknown or missing {names}")
    made = {name: _value(f"{kind.__name__}.{name}", *field, value[name]) for name, field in fields.items()}
    try:
        return kind(**made)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise MessageError(f"{kind.__name__}: {error}") from None


@functools.cache
def _fields(kind: type) -> dict[str, tuple[Any, Mapping[str, Any]]]:
    """Annotation and metadata of each field: working them out takes longer than reading a message."""
    hints = typing.get_type_hints(kind)
    return {field.name: (hints[field.name], field.metadata) for field in dataclasses.fields(kind)}


def _value(name: str, hint: Any, metadata: Any, value: Any) -> Any:  # noqa: ANN401, PLR0911
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if "dtype" in metadata:
        return _array(name, metadata, value)
    if origin is types.UnionType:
        if value is None:
            return None
        return _value(name, next(h for h in inner if h is not type(None)), metadata, value)
    if origin is tuple and isinstance(value, list):
        return tuple(_value(name, inner[0], metadata, item) for item in value)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast("type", hint), value)
    if hint is float and type(value) in (int, float) and math.isfinite(value):
        return float(value)
    if origin is dict and isinstance(value, dict):
        return value
    if hint in (int, bool, str) and type(value) is hint:
        return value
    raise MessageError(f"{name}: {_brief(value)!r} is not a {hint}")


def _brief(value: object) -> str:
    """What to say of a value in an error; never the text of something big or deep."""
    return str(value)[:40] if value is None or isinstance(value, (str, int, float)) else type(value).__name__


def _array(name: str, metadata: Any, value: object) -> AnyArray:  # noqa: ANN401
    if not isinstance(value, np.ndarray) or value.dtype.str != metadata["dtype"] or value.ndim != metadata["ndim"]:
        raise MessageError(f"{name}: expected an array {metadata['dtype']} of {metadata['ndim']} dimensions")
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        raise MessageError(f"{name}: not finite")
    if value.dtype.kind == "b" and (value.view(np.uint8) > 1).any():
        raise MessageError(f"{name}: not true or false")
    return value
