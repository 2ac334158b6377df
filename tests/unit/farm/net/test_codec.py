"""Received bytes: round trips, and MessageError for every kind of invalid input."""

import contextlib
import tracemalloc
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
import pytest
from covering import any_two
from hypothesis import example, given
from hypothesis import strategies as st
from wire import ext, pack

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray, array
from farm.errors import MessageError
from farm.net import codec
from farm.net.messages import Spec, WorkRequest
from farm.net.work import Chunk, Failure, Results, RoundHeader
from farm.sim.trajectory import Trajectory


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


def sample(**changes):
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


def body(**changes):
    """Return the sample as the map that goes over the wire."""
    plain = msgpack.unpackb(codec.encode(sample()), ext_hook=msgpack.ExtType)
    return plain | changes


def refused(payload, match, kind="bad", message=Sample):
    with pytest.raises(MessageError, match=match) as caught:
        codec.decode(payload, message)
    assert caught.value.kind == kind
    assert len(str(caught.value)) < 400


def assert_same(one, two):
    for name in one.__dataclass_fields__:
        a, b = getattr(one, name), getattr(two, name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), name
            assert a.tobytes() == b.tobytes(), name
        else:
            assert (type(a), a) == (type(b), b), name


# ---------------------------------------------------------------- round trips


def test_a_round_trip_keeps_every_bit():
    assert_same(codec.decode(codec.encode(sample()), Sample), sample())


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": None, "inner": None, "inners": (), "numbers": (), "settings": {}, "text": ""},
        {"doubles": np.zeros((0, 8)), "singles": np.zeros(0, "<f4"), "truths": np.zeros(0, bool)},
        {"doubles": np.zeros((3, 0)), "whole": np.zeros((0, 2, 2), dtype=np.int64)},
        {"doubles": np.arange(12.0).reshape(3, 4).T},
        {"doubles": np.arange(24.0).reshape(6, 4)[::2, ::-1]},
        {"doubles": np.full((300, 40), np.pi)},
        {"count": 0, "value": 0.0, "flag": False},
        {"whole": np.full((1, 1, 1), -(2**63))},
    ],
    ids=range(8),
)
def test_unusual_values_come_back(changes):
    assert_same(codec.decode(codec.encode(sample(**changes)), Sample), sample(**changes))


@given(values=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=20), shape=st.sampled_from([1, 2]))
def test_any_finite_numbers_come_back(values, shape):
    doubles = np.array(values * shape, dtype=float).reshape(shape, -1)
    back = codec.decode(codec.encode(sample(doubles=doubles)), Sample).doubles
    assert back.shape == doubles.shape
    assert back.tobytes() == doubles.tobytes()


def test_what_came_in_is_not_to_be_written_to():
    back = codec.decode(codec.encode(sample()), Sample)
    with pytest.raises(ValueError, match="read-only"):
        back.doubles[0, 0] = 1.0


def test_a_whole_number_is_taken_as_a_float():
    value = codec.decode(pack(body(value=2)), Sample).value
    assert value == 2.0
    assert type(value) is float


def test_what_cannot_be_sent_is_said():
    with pytest.raises(TypeError, match="cannot send a complex"):
        codec.encode(sample(text=1j))


# ---------------------------------------------------------------- refused


def test_a_truncated_message_is_refused_wherever_it_ends():
    payload = codec.encode(sample())
    for length in range(len(payload)):
        refused(payload[:length], "not a message")


@pytest.mark.parametrize("payload", [b"\x93\x01\x02\x03", b"\x01", b"\xc0", b"\xa3abc", pack([body()])], ids=str)
def test_what_is_not_a_map_is_refused(payload):
    refused(payload, "not a message: a")


def test_trailing_bytes_are_refused():
    refused(codec.encode(sample()) + b"\xc0", "not a message")


def test_an_oversized_message_is_refused_unread(monkeypatch):
    payload = codec.encode(sample())
    monkeypatch.setattr(codec, "MAX_BYTES", len(payload))
    codec.decode(payload, Sample)
    monkeypatch.setattr(codec, "MAX_BYTES", len(payload) - 1)
    monkeypatch.setattr(msgpack, "unpackb", None)
    refused(payload, f"a message of {len(payload)} bytes; at most {len(payload) - 1} are taken", "large")


STRANGE = [
    None,
    True,
    1.0,
    "1",
    -1,
    2**64 - 1,
    [],
    [[]],
    {},
    b"1",
    ext("<f8", [5], bytes(40)),
    ext("<i8", [1], bytes(8)),
]


@pytest.mark.parametrize("value", [*STRANGE, codec.SCHEMA - 1, codec.SCHEMA + 1], ids=str)
def test_another_schema_version_is_refused_as_such(value):
    refused(pack(body(schema=value)), "schema version .*, this side has 8: run the same release on both", "version")


def test_no_schema_version_is_refused_as_such():
    plain = body()
    del plain["schema"]
    refused(pack(plain), "schema version None", "version")


@pytest.mark.parametrize("value", [*STRANGE, "Inner", "sample"], ids=str)
def test_another_type_is_refused(value):
    refused(pack(body(type=value)), "where a Sample was expected")


def test_another_message_is_refused():
    refused(codec.encode(Inner(number=1, weight=2.0)), "a Inner where a Sample was expected")


def test_unknown_and_missing_fields_are_named():
    refused(pack(body(surprise=1)), "Sample: unknown or missing surprise$")
    refused(pack(body() | {b"raw": 1}), r"unknown or missing b'raw'$")
    for name in sample().__dataclass_fields__:
        plain = body()
        del plain[name]
        refused(pack(plain), f"Sample: unknown or missing {name}$")
    refused(pack(body(inner={"number": 1})), "Inner: unknown or missing weight")
    refused(pack(body(inners=[{"number": 1, "weight": 1.0, "schema": 1}])), "Inner: unknown or missing schema")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("text", value) for value in (None, 1, b"x", [], {}, True)),
        *(("count", value) for value in (None, 1.0, "1", True, [1])),
        *(("flag", value) for value in (None, 1, 0, "yes")),
        *(("value", value) for value in (None, "1", True, np.nan, np.inf, -np.inf, [1.0])),
        *(("settings", value) for value in (None, [], "x", 1)),
        *(("numbers", value) for value in (None, 1, [1.0], [None], ["1"], [True], [[1]], {})),
        *(("seed", value) for value in (1, "x", [None], {})),
        *(("inner", value) for value in (1, [], "x", {})),
        *(("inners", value) for value in (None, [None], [[]], {}, [1], "ab")),
        *((name, value) for name in ("doubles", "truths") for value in (None, [], [1.0], b"", {}, 1.0)),
        ("text", ext("<f8", [1], bytes(8))),
        ("count", ext("<i8", [], bytes(8))),
        ("inner", ext("<i8", [2], bytes(16))),
        ("text", msgpack.Timestamp(1, 2)),
    ],
    ids=str,
)
def test_a_field_of_another_type_is_refused(field, value):
    refused(pack(body(**{field: value})), r"Sample\.|Inner|where a")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("doubles", np.zeros((2, 2), "<f4")),
        ("doubles", np.zeros((2, 2), "<i8")),
        ("doubles", np.zeros(4)),
        ("doubles", np.zeros((2, 2, 1))),
        ("doubles", np.zeros(())),
        ("singles", np.zeros(2)),
        ("whole", np.zeros((1, 1, 1))),
        ("truths", np.zeros(3, dtype=np.int64)),
    ],
    ids=str,
)
def test_an_array_of_another_kind_is_refused(field, value):
    refused(pack(body(**{field: value})), rf"Sample\.{field}: expected an array .* dimensions")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["doubles", "singles"])
def test_numbers_that_are_not_finite_are_refused(field, bad):
    values = getattr(sample(), field).copy()
    values.flat[1] = bad
    refused(pack(body(**{field: values})), f"Sample.{field}: not finite")


def test_truths_are_one_or_nothing():
    refused(pack(body(truths=ext("|b1", [3], b"\x00\x01\x02"))), "Sample.truths: not true or false")


@pytest.mark.parametrize(
    "dtype", [">f8", "<c16", "|O", "<U4", "<M8[s]", "|u1", "<f2", "f8", "", "nonsense", 1, None, []]
)
def test_an_array_of_a_dtype_that_is_not_spoken_is_refused(dtype):
    refused(pack(body(doubles=ext(dtype, [2, 2], bytes(32)))), "not a message|unknown kind")


@pytest.mark.parametrize(
    "shape",
    [
        [2**40, 2**40],
        [2**62, 4],
        [2**32, 2**32],
        [64 * 2**20, 64 * 2**20, 64 * 2**20, 64 * 2**20],
        [0, 64 * 2**20, 64 * 2**20, 64 * 2**20],
        [-1, -4],
        [-1, 4],
        [2, 3],
        [1],
        [],
        [2.0, 2],
        [True, 4],
        ["2", 2],
        [None],
        [1] * 5,
        [[2, 2]],
        {"2": 2},
        "22",
        None,
        4,
    ],
    ids=str,
)
def test_an_array_of_an_impossible_shape_is_refused(shape):
    refused(pack(body(doubles=ext("<f8", shape, bytes(32)))), "not a message|unknown kind|shape|dimensions")


@pytest.mark.parametrize("payload", [b"", b"\xc0", b"\x92", b"\x92\xa3<f8", b"\x93\xa3<f8\x91\x00\x00", b"\xff" * 300])
def test_an_array_without_a_head_is_refused(payload):
    refused(pack(body(doubles=msgpack.ExtType(1, payload))), "not a message|unknown kind")


def test_another_extension_is_refused():
    refused(pack(body(doubles=ext("<f8", [2, 2], bytes(32), code=2))), "unknown extension 2")


@pytest.mark.parametrize("count", [-1, 99])
def test_what_a_message_itself_refuses_is_refused(count):
    refused(pack(body(count=count)), "^Sample: ")


# ---------------------------------------------------------------- bombs


def with_raw(field, raw):
    """Return the sample's bytes with a field's value given as bytes."""
    plain = body()
    parts = [msgpack.packb(name) + (raw if name == field else pack(value)) for name, value in plain.items()]
    return msgpack.Packer().pack_map_header(len(plain)) + b"".join(parts)


DEEP = [500, 1010, 100_000]


LISTS, MAPS, KEYS = b"\x91", b"\x81\xa1a", b"\x81\x91"
FIELDS = ("schema", "type", "text", "numbers", "settings", "inner", "inners", "doubles")


@pytest.mark.parametrize(*any_two(depth=DEEP, field=FIELDS, nest=(LISTS, MAPS, KEYS)))
def test_nesting_is_refused(depth, field, nest):
    payload = with_raw(field, nest * depth + b"\xc0")
    if field == "settings" and nest == MAPS:
        never_anything_else(payload, (Sample,))  # settings may be maps of maps
        return
    with pytest.raises(MessageError):
        codec.decode(payload, Sample)


def peak_of(payload, kind=Sample):
    """Return the most memory that decoding took [bytes]."""
    tracemalloc.start()
    try:
        codec.decode(payload, kind)
    except MessageError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


def bound(payload):
    """Return what decoding may take: small objects cost Python some 100 bytes per byte, never more."""
    return 200_000 + 150 * len(payload)


LIST, MAP = b"\xdd\x00\x01\x86\xa0", b"\xdf\x00\x01\x86\xa0"  # of 100000


@pytest.mark.parametrize(
    "payload",
    [
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc9\xff\xff\xff\xff\x01",
        b"\xc6\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        LIST * 400,
        (MAP + b"\xa0") * 400,
        LIST + b"\x90" * 1000,
        with_raw("numbers", LIST * 400),
        with_raw("settings", (MAP + b"\xa1a") * 400),
        with_raw("settings", b"\xdc\x27\x10" + b"\x80" * 10_000),
        with_raw("numbers", b"\xdc\x27\x10" + b"\x90" * 10_000),
        with_raw("doubles", pack(ext("<f8", [2**26, 2**26], b""))),
        with_raw("inners", b"\xdc\x03\xe8" + pack(ext("<f8", [0, 1], b"")) * 1000),
    ],
    ids=range(14),
)
def test_bombs_take_no_memory(payload):
    with pytest.raises(MessageError):
        codec.decode(payload, Sample)
    assert peak_of(payload) < bound(payload)


# ---------------------------------------------------------------- any bytes

KINDS = [Sample, Inner, WorkRequest, Spec, RoundHeader, Chunk, Results, Failure, Trajectory]

wild = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5)
    | st.builds(
        ext, st.sampled_from(["<f8", "|b1", "x"]), st.lists(st.integers(0, 3), max_size=3), st.binary(max_size=24)
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5) | st.binary(max_size=3), inner),
    max_leaves=12,
)


def never_anything_else(payload, kinds=tuple(KINDS)):
    for kind in kinds:
        with contextlib.suppress(MessageError):
            assert isinstance(codec.decode(payload, kind), kind)


@given(payload=st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_message_error(payload):
    never_anything_else(payload)


@given(value=wild)
def test_any_structure_is_a_message_or_a_message_error(value):
    never_anything_else(pack(value))


@given(fields=st.dictionaries(st.sampled_from(["schema", "type", *sample().__dataclass_fields__]), wild, max_size=3))
def test_any_value_in_any_field_is_a_message_or_a_message_error(fields):
    never_anything_else(pack(body(**fields)), (Sample,))


VALID = codec.encode(sample())


@given(
    start=st.integers(0, len(VALID)),
    length=st.integers(0, 20),
    instead=st.binary(max_size=20),
    doubled=st.booleans(),
)
@example(start=0, length=len(VALID), instead=b"", doubled=False)
@example(start=0, length=1, instead=b"\xdf\x00\x01\x86\xa0", doubled=True)
def test_mutated_bytes_are_a_message_or_a_message_error(start, length, instead, doubled):
    payload = VALID[:start] + instead + VALID[start + length :]
    never_anything_else(payload * (1 + doubled), (Sample,))
    assert peak_of(payload) < bound(payload)


def test_a_timestamp_is_a_number() -> None:
    """No object of msgpack's own is accepted in a table that is to become JSON."""
    body = msgpack.unpackb(codec.encode(sample()), ext_hook=msgpack.ExtType)
    body["settings"] = {"when": msgpack.Timestamp(7, 500_000_000)}
    settings = codec.decode(msgpack.packb(body), Sample).settings
    assert settings == {"when": 7.5}
    body["count"] = msgpack.Timestamp(7, 0)
    with pytest.raises(MessageError, match="Sample.count"):
        codec.decode(msgpack.packb(body), Sample)
