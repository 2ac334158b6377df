"""Every message comes back bit for bit and is taken for no other, and none that is cut or changed
is misread.
"""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from messages import MESSAGES
from wire import assert_same

from farm.errors import MessageError
from farm.net import codec


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_comes_back_bit_for_bit_and_is_taken_for_no_other(name):
    message = MESSAGES[name]
    payload = codec.encode(message)
    back = codec.decode(payload, type(message))
    assert_same(message, back)
    assert codec.encode(back) == payload
    for kind in {type(m) for m in MESSAGES.values()} - {type(message)}:
        with pytest.raises(
            MessageError, match=f"a {type(message).__name__} where a {kind.__name__} was expected"
        ):
            codec.decode(payload, kind)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_truncated_message_is_refused(name):
    payload = codec.encode(MESSAGES[name])
    for length in [*range(0, len(payload), max(1, len(payload) // 50)), len(payload) - 1]:
        with pytest.raises(MessageError):
            codec.decode(payload[:length], type(MESSAGES[name]))


@given(
    name=st.sampled_from(sorted(MESSAGES)),
    where=st.floats(0, 1),
    length=st.integers(0, 9),
    instead=st.binary(max_size=9),
)
def test_a_mutated_message_is_a_message_or_a_message_error(name, where, length, instead):
    payload = codec.encode(MESSAGES[name])
    start = int(where * min(len(payload), 400))  # structure stands in front
    with contextlib.suppress(MessageError):
        codec.decode(payload[:start] + instead + payload[start + length :], type(MESSAGES[name]))
