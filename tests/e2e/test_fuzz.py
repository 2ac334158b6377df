"""Invalid messages over a live session: nothing crashes, honest work continues, and all of them are
counted.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from processes import Farm, children

from farm.net import codec, session
from farm.net.messages import Refusal, WorkRequest
from farm.net.session import free_endpoint
from farm.net.work import Failure, RoundHeader

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]

SETTINGS = ("--name", "r", "--pairs", "6", "--generations", "200", "--no-record")
EXAMPLES = 600
TOPICS = ("want", "pairs", "generation", "result")
BOMB = b"\xdd\x00\x00\x10\x00" + (b"\xdd\x00\x00\x27\x10" + b"\x90" * 10_000) * 4096
"""41 MB that would be 2.5 GB of empty lists."""

VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**63), 2**64 - 1),
        st.floats(),
        st.text(max_size=20),
        st.binary(max_size=20),
        st.sampled_from([(2**40, 2**40), (3,), (0,), (1, 2, 3)]).map(
            lambda shape: _array("<f8", shape, b"")
        ),
        st.integers(0, 9).map(lambda n: _array("<f8", (n,), np.full(n, np.nan).tobytes())),
        st.integers(0, 99).map(
            lambda n: _array("<f4", (n, 15, 54), np.zeros((n, 15, 54), "<f4").tobytes())
        ),
        st.builds(msgpack.ExtType, st.integers(0, 100), st.binary(max_size=30)),
    ),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)


HONEST = (
    WorkRequest(
        worker="w/1", credits=1, idle=("r",), version="0", fingerprint="c", host="h", cores=2
    ),
    Failure(run="r", incarnation="i", round=1, worker="w/1", index=0, error="e"),
    RoundHeader(
        run="r", incarnation="i", round=1, generation=0, spec="s", traces="all", mu=np.zeros(2)
    ),
    Refusal(run="r", reason="so"),
)


def _array(dtype: str, shape: tuple[int, ...], raw: bytes) -> msgpack.ExtType:
    head = msgpack.packb([dtype, list(shape)])
    return msgpack.ExtType(1, bytes([len(head)]) + head + raw)


def spoilt(honest: bytes, data: st.DataObject) -> bytes:
    """An honest message with an error, which makes it different from every valid one."""
    body: dict[str, Any] = msgpack.unpackb(honest, ext_hook=msgpack.ExtType)
    how = data.draw(
        st.sampled_from(
            ["cut", "noise", "nested", "field", "missing", "foreign", "version", "stale"]
        )
    )
    if how == "cut":
        return honest[: data.draw(st.integers(0, len(honest) - 1))]
    if how == "noise":
        return data.draw(st.binary(max_size=200))
    if how == "nested":
        return b"\x91" * data.draw(st.sampled_from([100, 10_000, 1_000_000])) + b"\xc0"
    for name in {"incarnation", "worker"} & body.keys():
        body[name] = "0" * 16
    if how == "field":
        body[data.draw(st.sampled_from(sorted(body)))] = data.draw(VALUES)
    elif how == "missing":
        del body[data.draw(st.sampled_from(sorted(body.keys() - {"incarnation", "worker"})))]
    elif how == "foreign" and "run" in body:
        body["run"] = data.draw(st.text(max_size=30))
    elif how == "version":
        body["schema"] = codec.SCHEMA + data.draw(st.integers(1, 9))
    return msgpack.packb(body)


def test_nonsense_over_a_live_session(farm: Farm) -> None:
    farm.call("run", "--out", "undisturbed", *SETTINGS)
    endpoint = free_endpoint()
    learner = farm.start("learner", "--listen", endpoint, *SETTINGS)
    with session.connect((endpoint,), 20, lambda: False) as stranger:
        # Before the worker comes, which may ask for work only once
        stranger.subscribe("all", "farm/**")
        workers = farm.start("worker", "--connect", endpoint, "--workers", "1")
        honest = overheard(stranger)
        [worker] = children(workers.pid)

        @settings(
            max_examples=EXAMPLES,
            deadline=None,
            database=None,
            suppress_health_check=list(HealthCheck),
            derandomize=True,
        )
        @given(data=st.data())
        def attack(data: st.DataObject) -> None:
            key, payload = honest[data.draw(st.sampled_from(TOPICS))]
            stranger.publish(key, spoilt(payload, data))
            assert learner.poll() is None

        attack()
        key, payload = honest["result"]
        for _ in range(1000):
            stranger.publish(key, payload)  # by now of a round gone by
        for topic in TOPICS:
            stranger.publish(honest[topic][0], BOMB)  # the learner's link drops it unread
        assert learner.poll() is None, "over before the end of the attack"
        reached = len(farm.progress("r"))
        farm.wait_for(lambda: len(farm.progress("r")) >= min(reached + 10, 200))
        status: list[dict[str, Any]] = []

        def told_all() -> bool:
            status[:] = json.loads(farm.call("status", "--connect", endpoint, "--json"))
            return status[0]["ignored"].keys() >= {"bad", "version", "foreign", "stale", "flood"}

        farm.wait_for(told_all)  # the answer is made twice a second
        [run] = status
        assert sum(run["ignored"].get(kind, 0) for kind in ("stale", "unasked", "flood")) >= 900
        assert [one["worker"].partition("/")[2].partition("-")[0] for one in run["workers"]] == [
            str(worker)
        ]
        assert max(megabytes(learner.pid), megabytes(worker)) < 500
    assert children(workers.pid) == [worker], "the worker fell over"
    output, _ = learner.communicate(timeout=120)
    assert learner.returncode == 0, output
    assert "Traceback" not in output
    assert (
        farm.summary("r")["parameters_sha256"]
        == farm.json("undisturbed/r/summary.json")["parameters_sha256"]
    )


def overheard(stranger: session.Session) -> dict[str, tuple[str, bytes]]:
    """A valid message of each kind."""
    messages: dict[str, tuple[str, bytes]] = {}
    while set(messages) < set(TOPICS):
        event = stranger.events.get(timeout=20)
        for topic in TOPICS:
            if f"/{topic}" in event.key and event.payload:
                messages[topic] = event.key, event.payload
    return messages


def megabytes(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_nonsense_at_the_decoder_guided_by_coverage(farm: Farm) -> None:
    pytest.importorskip("atheris", reason="atheris is not installed")
    corpus = farm.folder / "corpus"
    corpus.mkdir()
    for number, message in enumerate(HONEST):
        for kind in range(8):
            (corpus / f"{number}-{kind}").write_bytes(bytes([kind]) + codec.encode(message))
    script = Path(__file__).parents[1] / "fuzz_codec.py"
    # The fuzzer reads its own peak memory, which on Linux survives exec. Without a shell between
    # them that would be the memory of this process.
    fuzzer = farm.start_program(
        "sh",
        "-c",
        '"$@"; exit $?',
        "sh",
        sys.executable,
        str(script),
        str(corpus),
        "-max_total_time=20",
        "-rss_limit_mb=1024",
        "-seed=1",
    )
    output, _ = fuzzer.communicate(timeout=120)
    assert fuzzer.returncode == 0, output[-3000:]
    assert "Done " in output
