"""The learner's side of the network, against workers and sessions that are hostile; no physics."""

import math
from dataclasses import replace

import pytest
from doubles import FARM, NEWER, WAIT, Hire, Learner, done, jobs, request

from farm.net import codec, keys
from farm.net.messages import Refusal
from learner.pool import status, workforce


def test_messages_that_do_not_count(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec, "MAX_BYTES", 100_000)
    pool = learner.show()
    worker = hire("a/1")
    inbox = keys.want(FARM, worker.name)
    for nonsense in (b"", b"\xc1", NEWER, request("b/1", 50)):
        worker.say(inbox, nonsense)
    worker.want(1)
    collected = learner.collect(jobs(4))
    first = worker.chunk()
    honest = worker.results(first)
    bad = [
        b"",
        b"no message",
        b"\x80",
        b"\0" * 200_000,
        NEWER,
        replace(honest, returns=honest.returns[:1], flags=honest.flags[:1], steps=honest.steps[:1]),
        worker.results(first, -1),
        replace(honest, traces=honest.traces[:, 1:]),
        worker.results(first, 4),
        replace(honest, run="other"),
        replace(honest, worker="b/1"),
        replace(honest, round=0),
        replace(honest, incarnation="0" * 16),
        request("a/1"),
        worker.failure(first, 99, "no"),
        replace(worker.failure(first, 0, "no"), incarnation="gone"),
    ]
    for message in bad:
        worker.answer(message)
    assert pool.workers == ("a/1",), "a worker joined by the message of another worker"
    worker.answer(honest)
    worker.answer(worker.results(first, 0, value=7.0))
    worker.work(3)
    results = collected.result(WAIT)
    assert done(results) == list(range(4))
    assert pool.notices.ignored == {
        "bad": 2 + 8,
        "version": 1 + 2,
        "large": 1,
        "foreign": 1 + 2,
        "stale": 3,
        "doubled": 1,
    }


def test_another_release_in_a_workers_name_does_not_shut_it_out(
    learner: Learner, hire: Hire
) -> None:
    pool = learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(2))
    first = worker.chunk()
    worker.say(keys.want(FARM, worker.name), NEWER)
    worker.answer(worker.results(first))
    worker.work(1)
    assert done(collected.result(WAIT)) == [0, 1]
    assert pool.notices.ignored == {"version": 1}


def test_made_up_names_are_ignored(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workforce, "_SOON", 0.0)
    monkeypatch.setattr(status, "_PERIOD", 0.0)
    monkeypatch.setattr(status, "_PART", math.inf)
    pool = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(30))
    for i in range(500):
        worker.say(keys.want(FARM, f"nobody/{i}"), request(f"nobody/{i}", 9))
    worker.want(10)
    worker.work(30)
    collected.result(WAIT)
    assert pool.workers == ("a/1",)
    assert [member.worker for member in pool.census()] == ["a/1"]
    collected = learner.collect(jobs(1))
    worker.work(1)
    collected.result(WAIT)
    assert pool.notices.ignored == {"absent": 500}


def test_hostile_lines_are_told_of_once(
    learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    chunk = worker.chunk()
    for _ in range(50):
        worker.answer(b"rubbish")
    worker.answer(worker.results(chunk))
    collected.result(WAIT)
    assert learner.pool.notices.ignored == {"bad": 50}
    assert sum("ignored a message" in line for line in caplog.messages) == 1


def test_another_release_hears_why_it_gets_nothing(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    other, worker = hire("a/1"), hire("b/1")
    other.session.subscribe("refused", keys.refused(FARM, "a/1"))
    collected = learner.collect(jobs(2))
    other.say(keys.want(FARM, "a/1"), NEWER)
    assert "run the same release on both" in codec.decode(other.next("refused"), Refusal).reason
    worker.want(2)
    worker.work(2)
    collected.result(WAIT)
    assert pool.notices.ignored == {"version": 1}


def test_a_worker_that_claims_other_numbers_gets_nothing_even_if_it_is_the_first(
    learner: Learner, hire: Hire
) -> None:
    pool = learner.show()
    odd = hire("a/1")
    collected = learner.collect(jobs(3))
    odd.say(keys.want(FARM, "a/1"), request("a/1", 1, fingerprint="odd"))
    assert "rounds differently" in codec.decode(odd.refusal(), Refusal).reason
    worker = hire("b/1")
    worker.want(2)
    chunk = worker.chunk()
    odd.answer(odd.results(chunk, value=9.0))
    odd.say(keys.want(FARM, "a/1"), request("a/1", 1, fingerprint="odd"))
    odd.refusal()  # the learner has both messages
    worker.answer(worker.results(chunk))
    worker.work(3 - len(chunk))
    assert done(collected.result(WAIT)) == [0, 1, 2]
    assert pool.notices.ignored == {"refused": 1}


def test_patterns_are_not_names(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(1))
    for name in ("**", "*/*", "a/**"):
        worker.say(keys.want(FARM, name), request(name))
    worker.want(1)
    worker.work(1)
    collected.result(WAIT)
    assert pool.notices.ignored == {"foreign": 3}
