"""The test vectors equal our messages, encoded by our codec and by plain msgpack, and can be
decoded.
"""

import importlib.util
import json
import struct
from pathlib import Path
from typing import Any

import msgpack
import pytest
from vectors import FOLDER, MESSAGES, described

from farm.net import codec

TABLE = json.loads((FOLDER / "messages.json").read_text())
LETTERS = {"<f8": "d", "<f4": "f", "<i8": "q", "|b1": "?"}


def test_the_table_says_what_is_there() -> None:
    assert (FOLDER / "messages.json").read_text() == described(), (
        "run tests/vectors/vectors.py: the messages changed"
    )
    assert {path.name for path in FOLDER.glob("*.bin")} == {entry["file"] for entry in TABLE}


@pytest.mark.parametrize("name", MESSAGES)
def test_our_codec_writes_and_reads_them(name: str) -> None:
    _, message = MESSAGES[name]
    payload = (FOLDER / f"{name}.bin").read_bytes()
    assert codec.encode(message) == payload
    assert codec.encode(codec.decode(payload, type(message))) == payload


def packed(value: Any) -> Any:
    """The JSON values, packed by plain msgpack."""
    if isinstance(value, dict) and value.keys() == {"dtype", "shape", "values"}:
        head = msgpack.packb([value["dtype"], value["shape"]])
        numbers = struct.pack(f"<{len(value['values'])}{LETTERS[value['dtype']]}", *value["values"])
        return msgpack.ExtType(1, bytes([len(head)]) + head + numbers)
    if isinstance(value, dict):
        return {name: packed(each) for name, each in value.items()}
    return [packed(each) for each in value] if isinstance(value, list) else value


def unpacked(_: int, data: bytes) -> dict[str, Any]:
    (dtype, shape), raw = msgpack.unpackb(data[1 : 1 + data[0]]), data[1 + data[0] :]
    numbers = struct.unpack(f"<{len(raw) // struct.calcsize(LETTERS[dtype])}{LETTERS[dtype]}", raw)
    return {"dtype": dtype, "shape": shape, "values": list(numbers)}


@pytest.mark.parametrize("entry", TABLE, ids=[entry["file"] for entry in TABLE])
def test_plain_msgpack_writes_and_reads_them(entry: dict[str, Any]) -> None:
    payload = (FOLDER / entry["file"]).read_bytes()
    assert msgpack.packb(packed(entry["message"])) == payload
    assert msgpack.unpackb(payload, ext_hook=unpacked) == entry["message"]


def test_the_robot_of_the_examples_reads_and_writes_arrays_alike() -> None:
    path = Path(__file__).parents[4] / "examples" / "robot_worker.py"
    spec = importlib.util.spec_from_file_location("robot_worker", path)
    assert spec is not None
    assert spec.loader is not None
    robot = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(robot)
    assert robot.SCHEMA == codec.SCHEMA
    for entry in TABLE:
        for value in entry["message"].values():
            if isinstance(value, dict) and "dtype" in value:
                ours = packed(value)
                assert robot.array(value["dtype"], value["shape"], value["values"]) == ours
                assert list(robot.numbers(1, ours.data)) == value["values"]
