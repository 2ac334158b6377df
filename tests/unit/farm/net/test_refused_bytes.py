"""Received bytes that are not the expected message: a MessageError that says what is wrong with
them.
"""

import msgpack
import numpy as np
import pytest
from specimen import Inner, Sample, body, sample
from wire import ext, pack

from farm.errors import MessageError
from farm.net import codec


def refused(payload, match, kind="bad"):
    with pytest.raises(MessageError, match=match) as caught:
        codec.decode(payload, Sample)
    assert caught.value.kind == kind
    assert len(str(caught.value)) < 400


def test_a_truncated_message_is_refused_wherever_it_ends():
    payload = codec.encode(sample())
    for length in range(len(payload)):
        refused(payload[:length], "not a message")


@pytest.mark.parametrize(
    "payload", [b"\x93\x01\x02\x03", b"\x01", b"\xc0", b"\xa3abc", pack([body()])], ids=str
)
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
    refused(
        payload, f"a message of {len(payload)} bytes; at most {len(payload) - 1} are taken", "large"
    )


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
    refused(
        pack(body(schema=value)),
        "schema version .*, this side has 11: run the same release on both",
        "version",
    )


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
    refused(
        pack(body(inners=[{"number": 1, "weight": 1.0, "schema": 1}])),
        "Inner: unknown or missing schema",
    )


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
        *(
            (name, value)
            for name in ("doubles", "truths")
            for value in (None, [], [1.0], b"", {}, 1.0)
        ),
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
    refused(
        pack(body(doubles=ext("<f8", shape, bytes(32)))),
        "not a message|unknown kind|shape|dimensions",
    )


@pytest.mark.parametrize(
    "payload", [b"", b"\xc0", b"\x92", b"\x92\xa3<f8", b"\x93\xa3<f8\x91\x00\x00", b"\xff" * 300]
)
def test_an_array_without_a_head_is_refused(payload):
    refused(pack(body(doubles=msgpack.ExtType(1, payload))), "not a message|unknown kind")


def test_another_extension_is_refused():
    refused(pack(body(doubles=ext("<f8", [2, 2], bytes(32), code=2))), "unknown extension 2")


@pytest.mark.parametrize("count", [-1, 99])
def test_what_a_message_itself_refuses_is_refused(count):
    refused(pack(body(count=count)), "^Sample: ")


def test_a_timestamp_is_a_number() -> None:
    """No object of msgpack's own is accepted in a table that is to become JSON."""
    settings = codec.decode(
        pack(body(settings={"when": msgpack.Timestamp(7, 500_000_000)})), Sample
    ).settings
    assert settings == {"when": 7.5}
    refused(pack(body(count=msgpack.Timestamp(7, 0))), "Sample.count")
