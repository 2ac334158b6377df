"""Any bytes at all: a message or a MessageError, and no more memory than is in proportion."""

import contextlib
import tracemalloc

import msgpack
import pytest
from covering import any_two
from hypothesis import example, given
from hypothesis import strategies as st
from specimen import Inner, Sample, body, sample
from wire import ext, pack

from farm.errors import MessageError
from farm.net import codec
from farm.net.messages import Spec, WorkRequest
from farm.net.work import Chunk, Failure, Results, RoundHeader
from farm.sim.trajectory import Trajectory


def with_raw(field, raw):
    """Return the sample's bytes with a field's value given as bytes."""
    plain = body()
    parts = [
        msgpack.packb(name) + (raw if name == field else pack(value))
        for name, value in plain.items()
    ]
    return msgpack.Packer().pack_map_header(len(plain)) + b"".join(parts)


LISTS, MAPS, KEYS = b"\x91", b"\x81\xa1a", b"\x81\x91"
FIELDS = ("schema", "type", "text", "numbers", "settings", "inner", "inners", "doubles")


@pytest.mark.parametrize(
    *any_two(depth=(500, 1010, 100_000), field=FIELDS, nest=(LISTS, MAPS, KEYS))
)
def test_nesting_is_refused(depth, field, nest):
    payload = with_raw(field, nest * depth + b"\xc0")
    if field == "settings" and nest == MAPS:
        never_anything_else(payload, (Sample,))  # settings may be maps of maps
        return
    with pytest.raises(MessageError):
        codec.decode(payload, Sample)


def peak_of(payload):
    """Return the most memory that decoding took [bytes]."""
    tracemalloc.start()
    try:
        codec.decode(payload, Sample)
    except MessageError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


def bound(payload):
    """Return what decoding may take: small objects cost Python some 100 bytes per byte, never
    more.
    """
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


KINDS = [Sample, Inner, WorkRequest, Spec, RoundHeader, Chunk, Results, Failure, Trajectory]

wild = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5)
    | st.builds(
        ext,
        st.sampled_from(["<f8", "|b1", "x"]),
        st.lists(st.integers(0, 3), max_size=3),
        st.binary(max_size=24),
    ),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=5) | st.binary(max_size=3), inner)
    ),
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


@given(
    fields=st.dictionaries(
        st.sampled_from(["schema", "type", *sample().__dataclass_fields__]), wild, max_size=3
    )
)
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
