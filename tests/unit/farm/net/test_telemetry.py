"""Messages from learners to observers: tables in them are valid JSON, even from a hostile
sender.
"""

from typing import Any

import msgpack
import numpy as np
import pytest

from farm.errors import MessageError
from farm.net import codec
from farm.net.stats import GenerationStats
from farm.net.telemetry import RunEnd, RunHistory, RunStatus, WorkerStatus

WORKER: Any = {
    "worker": "w/1",
    "host": "h",
    "cores": 1,
    "version": "1",
    "fingerprint": "c",
    "rollouts": 1,
    "rate": 1.0,
    "seen": 1.0,
}
STATUS: Any = {
    "run": "r",
    "generation": 1,
    "generations": 2,
    "return_mean": None,
    "mean_policy_return": None,
    "open": 0,
    "reissued": 0,
    "refused": 0,
    "workers": (WorkerStatus(**WORKER),),
}


@pytest.mark.parametrize(
    "ignored",
    [
        {"a": 1, b"b": 2},
        {"a": "b"},
        {"a": np.zeros(2)},
        {"a" * 300: 1},
        {str(i): i for i in range(30)},
    ],
    ids=["keys", "texts", "arrays", "long", "many"],
)
def test_forged_counts(ignored: dict[Any, Any]) -> None:
    for forged in (RunStatus(ignored={}, **STATUS), WorkerStatus(**WORKER)):
        forged.ignored.update(ignored)
        with pytest.raises(
            MessageError, match="ignored messages that are not a few numbers by kind"
        ):
            codec.decode(codec.encode(forged), type(forged))


def test_a_timestamp_among_counts() -> None:
    forged = RunStatus(ignored={}, **STATUS)
    forged.ignored["a"] = msgpack.Timestamp(1, 0)  # type: ignore[assignment]
    with pytest.raises(MessageError, match="ignored messages"):
        codec.decode(codec.encode(forged), RunStatus)


@pytest.mark.parametrize("value", [np.zeros(2), np.zeros(()), b"2", {b"a": 1}, [[np.zeros(3)]]])
def test_tables_are_as_json_has_them(value: object) -> None:
    table: dict[str, Any] = {}
    forged = (
        RunEnd(summary=table, lines=(), best=None, best_generation=0, mean=None),
        RunHistory(
            run="r",
            incarnation="i",
            recording="r",
            config=table,
            files={},
            generation=0,
            reports=(),
            end=None,
        ),
    )
    table["version"] = value
    for message in forged:
        with pytest.raises(MessageError, match="in a JSON table|a name that is a bytes"):
            codec.decode(codec.encode(message), type(message))


@pytest.mark.parametrize("version", [np.array([2, 2]), np.array(2), [2], True, None])
def test_a_line_of_another_version(version: object) -> None:
    with pytest.raises(ValueError, match="not a line of progress.jsonl, version 2"):
        GenerationStats.from_dict({"version": version})
