"""Encodes dataclasses as bytes and decodes them with checks; the only module that uses msgpack.

The structure is msgpack; an array is an extension with dtype, shape and raw bytes. A field's
annotation defines its valid values; for arrays, `array(...)` gives dtype and number of dimensions.
Its name is its key, unless `keyed(...)` gives one.
Decoding raises nothing but MessageError, whatever the bytes.
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sized
from typing import Any, Final, TypeVar

import msgpack
import numpy as np

from farm.arrays import AnyArray
from farm.errors import MessageError

SCHEMA: Final = 11
"""Version of all messages; included in each of them."""

MAX_BYTES: Final = 64 * 1024 * 1024
"""Larger messages are refused unread."""

_ARRAY: Final = 1  # msgpack's extension code
_DTYPES: Final = ("<f8", "<f4", "<i8", "|b1")
_LENGTH: Final = 10_000  # items of one list or map
_ITEMS: Final = 500_000  # of all lists and maps of a message: most data is in arrays

_TEXT: Final = 1000  # characters of a name or a line

M = TypeVar("M")
C = TypeVar("C", bound=Sized)


def keyed(key: str) -> Any:  # noqa: ANN401  as dataclasses.field is typed
    """A dataclass field with another key than its name: that of files of earlier releases."""
    return dataclasses.field(metadata={"key": key})


def encode(message: object, schema: int | None = None, without: Collection[str] = ()) -> bytes:
    """The message with its type's name and the schema version; perhaps without some of its
    fields.
    """
    fields = {key: value for key, value in _plain(message).items() if key not in without}
    body = {
        "schema": SCHEMA if schema is None else schema,
        "type": type(message).__name__,
        **fields,
    }
    return bytes(msgpack.packb(body, default=_pack, use_bin_type=True) or b"")


def decode(payload: bytes, kind: type[M], schema: int | None = None, most: int | None = None) -> M:
    """Decode a message of that type.

    Args:
      payload: the bytes.
      kind: the message's type.
      schema: expected version, by default SCHEMA.
      most: maximum size [bytes], by default MAX_BYTES; files may be larger than messages.

    Raises:
      MessageError: oversized ("large"), not msgpack, of the wrong shape or of another type
        ("bad"), or of another schema version ("version").
    """
    most = MAX_BYTES if most is None else most
    if len(payload) > most:
        raise MessageError(f"a message of {len(payload)} bytes; at most {most} are taken", "large")
    try:
        structure = msgpack.Unpacker(max_buffer_size=max(len(payload), 1))
        structure.feed(payload)
        structure.skip()  # check that all announced bytes are there before anything is allocated
        items = _Items()
        body = msgpack.unpackb(
            payload,
            ext_hook=_unpack,
            list_hook=items.count,
            object_hook=items.count,
            strict_map_key=True,
            timestamp=1,
            max_array_len=_LENGTH,
            max_map_len=_LENGTH,
        )
    except MessageError:
        raise
    except Exception as error:  # msgpack and its hooks raise many kinds
        raise MessageError(f"not a message: {error}") from None
    if not isinstance(body, dict):
        raise MessageError(f"not a message: a {type(body).__name__}")
    version, name, ours = body.get("schema"), body.get("type"), SCHEMA if schema is None else schema
    if type(version) is not int or version != ours:
        raise MessageError(
            f"schema version {_brief(version)}, this side has {ours}: run the same release on both",
            "version",
        )
    if type(name) is not str or name != kind.__name__:
        raise MessageError(f"a {_brief(name)} where a {kind.__name__} was expected")
    try:
        return typing.cast("M", _build(kind, body, {"schema", "type"}))
    except RecursionError:
        raise MessageError("nested too deeply") from None


def _plain(value: Any) -> dict[str, Any]:  # noqa: ANN401
    return {key: getattr(value, name) for key, name in _names(type(value))}


@functools.cache
def _names(kind: type) -> tuple[tuple[str, str], ...]:
    """Keys and names of the fields."""
    return tuple((_key(field), field.name) for field in dataclasses.fields(kind))


def _key(field: "dataclasses.Field[Any]") -> str:
    return str(field.metadata.get("key", field.name))


def _pack(value: object) -> object:
    if isinstance(value, np.ndarray):
        return msgpack.ExtType(_ARRAY, _head(value.dtype.str, value.shape) + value.tobytes())
    if dataclasses.is_dataclass(value):
        return _plain(value)
    raise TypeError(f"cannot send a {type(value).__name__}")


class _Items:
    """Limits an unpacked message's memory: a list of empty lists takes 60 times as much as its
    bytes.
    """

    def __init__(self) -> None:
        self._left = _ITEMS

    def count(self, container: C) -> C:
        """Count a complete list or map, and return it.

        Raises:
          MessageError: the message has too many items in total.
        """
        self._left -= 1 + len(container)
        if self._left < 0:
            raise MessageError(f"more than {_ITEMS} items", "large")
        return container


@functools.lru_cache(1000)
def _head(dtype: str, shape: tuple[int, ...]) -> bytes:
    """The header before an array's bytes: its own length as one byte, dtype and shape."""
    head = bytes(msgpack.packb([dtype, shape]) or b"")
    return bytes([len(head)]) + head


def _unpack(code: int, payload: bytes) -> AnyArray:
    if code != _ARRAY:
        raise MessageError(f"unknown extension {code}")
    end = 1 + (payload[0] if payload else 0)
    dtype, shape, size = _announced(payload[1:end])
    raw = memoryview(payload)[end:]
    if size != len(raw):
        raise MessageError(f"an array of shape {shape} in {len(raw)} bytes")
    return np.frombuffer(raw, dtype=dtype).reshape(shape)


@functools.lru_cache(1000)
def _announced(head: bytes) -> tuple["np.dtype[Any]", tuple[int, ...], int]:
    """Read an array's header: dtype, shape, and size [bytes]."""
    dtype, shape = msgpack.unpackb(head, max_array_len=16)
    if (
        dtype not in _DTYPES
        or not all(type(n) is int and 0 <= n <= MAX_BYTES for n in shape)
        or len(shape) > 4
    ):
        raise MessageError("an array of an unknown kind")
    kind = np.dtype(dtype)
    return kind, tuple(shape), math.prod(shape) * kind.itemsize


def _build(kind: type, value: object, extra: set[str] | None = None) -> object:
    """Make a dataclass from a map, with every field checked."""
    if not isinstance(value, dict):
        raise MessageError(f"a {type(value).__name__} where a {kind.__name__} was expected")
    fields = _fields(kind)
    unknown = value.keys() - fields.keys() - (extra or set())
    missing = fields.keys() - value.keys() - _optional(kind)
    if unknown or missing:
        names = ", ".join(sorted(str(name)[:40] for name in unknown | missing))
        raise MessageError(f"{kind.__name__}: unknown or missing {names}")
    present = {key: value[key] for key in fields if key in value}
    arguments = {fields[key].name: fields[key].check(each) for key, each in present.items()}
    try:
        return kind(**arguments)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise MessageError(f"{kind.__name__}: {error}") from None


Check = Callable[[Any], Any]
"""Returns a field's checked value, or raises MessageError."""


class _Field(typing.NamedTuple):
    name: str
    check: Check


@functools.cache
def _fields(kind: type) -> dict[str, _Field]:
    """Fields by key; cached because making their checks takes longer than reading a message."""
    hints = typing.get_type_hints(kind)
    return {
        _key(field): _Field(
            field.name,
            _check(f"{kind.__name__}.{_key(field)}", hints[field.name], field.metadata),
        )
        for field in dataclasses.fields(kind)
    }


@functools.cache
def _optional(kind: type) -> frozenset[str]:
    """Keys of fields with a default; these may be missing, as in files of older releases."""
    fields, none = dataclasses.fields(kind), dataclasses.MISSING
    return frozenset(
        _key(f) for f in fields if f.default is not none or f.default_factory is not none
    )


def _check(name: str, hint: Any, metadata: Mapping[str, Any]) -> Check:  # noqa: ANN401
    """The check for a field with that annotation."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if "dtype" in metadata:
        return functools.partial(_array, name, metadata["dtype"], metadata["ndim"])
    if origin is types.UnionType:
        check = _check(name, next(h for h in inner if h is not type(None)), metadata)
        return lambda value: None if value is None else check(value)
    if origin is tuple:
        return functools.partial(_tuple, name, hint, _check(name, inner[0], metadata))
    if dataclasses.is_dataclass(hint):
        return functools.partial(_build, hint)
    if hint is float:
        return functools.partial(_float, name)
    return functools.partial(_exactly, name, hint, dict if origin is dict else hint)


def _exactly(name: str, hint: Any, kind: type, value: object) -> object:  # noqa: ANN401
    if type(value) is not kind:
        raise _mismatch(name, hint, value)
    if type(value) is str and len(value) > _TEXT:
        raise MessageError(
            f"{name}: a text of {len(value)} characters, at most {_TEXT} are taken", "large"
        )
    return value


def _float(name: str, value: Any) -> float:  # noqa: ANN401
    if type(value) in (int, float) and math.isfinite(value):
        return float(value)
    raise _mismatch(name, float, value)


def _tuple(name: str, hint: Any, item: Check, value: object) -> tuple[Any, ...]:  # noqa: ANN401
    if type(value) is list:
        return tuple(item(one) for one in value)
    raise _mismatch(name, hint, value)


def _mismatch(name: str, hint: Any, value: object) -> MessageError:  # noqa: ANN401
    return MessageError(f"{name}: {_brief(value)!r} is not a {hint}")


def _brief(value: object) -> str:
    """A short description of a value for an error; for containers only the type."""
    return (
        str(value)[:40]
        if value is None or isinstance(value, (str, int, float))
        else type(value).__name__
    )


def _array(name: str, dtype: "np.dtype[Any]", ndim: int, value: object) -> AnyArray:
    if not isinstance(value, np.ndarray) or value.dtype != dtype or value.ndim != ndim:
        raise MessageError(f"{name}: expected an array {dtype.str} of {ndim} dimensions")
    if dtype.kind == "f" and not np.isfinite(value).all():
        raise MessageError(f"{name}: not finite")
    if dtype.kind == "b" and value.tobytes().strip(b"\0\1"):
        raise MessageError(f"{name}: not true or false")
    return value
