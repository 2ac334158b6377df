"""Round trips of messages: every bit comes back, whatever the values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from specimen import Sample, body, sample
from wire import assert_same, pack

from farm.net import codec


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


@given(
    values=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=20),
    shape=st.sampled_from([1, 2]),
)
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
