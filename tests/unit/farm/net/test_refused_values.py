"""Values that no message of their kind can have are refused, where it is made and where it is
received.
"""

import dataclasses

import msgpack
import numpy as np
import pytest
from made import report
from messages import HEAD, JOBS, MESSAGES, STATS, P
from wire import pack

from farm.errors import MessageError
from farm.net import codec
from farm.net.work import RATES, Failure

TABLE = JOBS.table


def changed(column, value):
    """The table with another value in its last row."""
    table = TABLE.copy()
    table[-1, column] = value
    return table


STRANGE = {  # by column
    0: (TABLE[0, 0], -1, 2**31, -(2**63)),  # a job twice
    1: (-1, 2),
    2: (-1, 2),
    3: (-1, len(RATES)),
    4: (0, 2, -2, -(2**63)),
    5: (2, -2),
    **{column: (-1, -2, 2**32) for column in range(6, 10)},  # half a seed
}

NONE = np.zeros(0, "<i8")
REFUSED = {
    "request": [
        {"credits": -1},
        {"credits": 100_001},
        {"idle": ("r",) * 1001},
        {"ignored": {"stale": "many"}},
        {"ignored": {"s" * 251: 1}},
        {"ignored": dict.fromkeys("abcdefghijklmnopqrstuvwxyz", 1)},
        {"worker": "a/" + "1" * 250},
        {"host": "\x1b[2J"},
    ],
    "round": [{"traces": "some"}],
    "normalised round": [
        {"normaliser": np.ones((2, 1, 3))},
        {"normaliser": np.zeros((2, 2, 3))},
    ],
    "results with moments": [
        {"moments": np.zeros((1, 7))},
        {"moments": np.zeros((2, 6))},
        {"moments": np.full((2, 7), -1.0)},
        {"moments": np.array([[1.0, 0.0, 1.0, 1.0, -1.0]] * 2)},
    ],
    "spec": [
        {"code": {"task": 1}},
        {"files": {"model.xml": None}},
        {"files": {b"model.xml": ""}},
        {"constants": {"phases": 1.0}},
        {"constants": {"phases": [1.0]}},
        {"constants": {"phases": np.zeros(5, "<f4")}},
        {"constants": {"phases": np.array([np.nan])}},
    ],
    "chunk": [
        {"table": np.zeros((0, 10), dtype=np.int64)},
        {"table": np.zeros((4, 0), dtype=np.int64)},
        {"table": TABLE[:3]},
        {"table": TABLE[:, :9]},
        {"table": np.hstack([TABLE, TABLE[:, :1]])},
        *(
            {"table": changed(column, value)}
            for column, values in STRANGE.items()
            for value in values
        ),
        {"eps": np.zeros((1, P))},
        {"eps": np.zeros((5, P))},
    ],
    "results": [
        {"jobs": np.zeros(2, dtype=np.int64)},
        {"jobs": np.zeros(0, dtype=np.int64)},
        {"jobs": np.arange(6)},
        {"jobs": np.array([0, 9, 3])},
        {"jobs": np.array([0, 3, 3])},
        {"returns": np.zeros(1)},
        {"flags": np.zeros((3, 4), dtype=bool)},
        {"flags": np.zeros((5, 3), dtype=bool)},
        {"steps": np.ones(4, dtype=np.int64)},
    ],
    "results of one": [
        {"jobs": NONE, "returns": np.zeros(0), "flags": np.zeros((0, 4), bool), "steps": NONE},
    ],
    "failure": [{"error": text} for text in ("x" * 1001, "two\nlines", "\x1b[2J")],
    "trajectory": [
        {"bodies": np.zeros((3, 3, 7), "<f4")},
        {"actions": np.full((4, 2), np.inf, "<f4")},
        *(
            {"times": np.array(times)}
            for times in ([], [0.1], [0.0, 0.2, 0.1, 0.3], [0.0, 0.0, 0.1, 0.2])
        ),
        *(
            {"channels": {"force": wrong}}
            for wrong in (
                1.0,
                [0.0] * 4,
                "four",
                np.zeros((3, 3), "<f4"),
                np.zeros((4, 3)),
                np.zeros((), "<f4"),
                np.full((4, 3), np.nan, "<f4"),
            )
        ),
        {"channels": {f"c{i}": np.zeros((4, 1), "<f4") for i in range(101)}},
    ],
}
CASES = [(name, change) for name, changes in REFUSED.items() for change in changes]


@pytest.mark.parametrize(
    ("name", "change"), CASES, ids=[f"{n}-{'-'.join(c)}-{i}" for i, (n, c) in enumerate(CASES)]
)
def test_values_that_make_no_sense_are_refused(name, change):
    message = MESSAGES[name]
    with pytest.raises(ValueError, match="."):
        dataclasses.replace(message, **change)
    packed = {
        key: list(value) if isinstance(value, tuple) else value for key, value in change.items()
    }
    plain = msgpack.unpackb(codec.encode(message), ext_hook=msgpack.ExtType) | packed
    with pytest.raises(MessageError, match=f"^{type(message).__name__}[:.]"):
        codec.decode(pack(plain), type(message))


@pytest.mark.parametrize(
    ("name", "field"), [("refusal", "reason"), ("results", "worker"), ("spec", "task")]
)
def test_texts_have_an_end(name, field):
    message = dataclasses.replace(MESSAGES[name], **{field: "x" * 1001})
    with pytest.raises(MessageError, match=r"a text of 1001 characters, at most 1000 are taken"):
        codec.decode(codec.encode(message), type(message))


@pytest.mark.parametrize(
    ("name", "shape"), [("best", (2, 15, 54)), ("worst", (0, 15, 54)), ("../best", (1, 15, 54))]
)
def test_traces_that_make_no_sense_are_refused(name, shape):
    with pytest.raises(ValueError, match="traces "):
        report(STATS, traces={name: np.zeros(shape, "<f4")})


@pytest.mark.parametrize(
    "lines", [["x"] * 41, ["x" * 1001], ["\x1b[2J"], ["two\nlines"]], ids=range(4)
)
def test_a_traceback_that_cannot_be_shown_is_refused(lines: list[str]) -> None:
    body = {
        "schema": codec.SCHEMA,
        "type": "Failure",
        **HEAD,
        "worker": "w/1",
        "index": 0,
        "error": "e",
    }
    assert codec.decode(msgpack.packb(body | {"traceback": ["  x"]}), Failure).traceback == ("  x",)
    with pytest.raises(MessageError):
        codec.decode(msgpack.packb(body | {"traceback": lines}), Failure)
