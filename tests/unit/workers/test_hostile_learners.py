"""A worker with learners and sessions that are faulty or hostile."""

import logging
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from stage import FARM, WAIT, Learner, P, Runner, Stage, at_work, indices, until

from farm.net import codec, keys
from farm.net.messages import Refusal, WorkRequest
from farm.net.session import connect
from farm.net.work import Results
from farm.sim.engines import CAPACITY
from workers import inbox
from workers import worker as workers
from workers.worker import Worker


def test_chunks_of_rounds_gone_by_are_dropped(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.announce()
    learner.send(worker.id, 0, round=1)
    learner.send(worker.id, 1, incarnation="before")
    learner.send(worker.id, 2)
    assert indices(stage.results()) == [2]


def test_messages_it_cannot_read(
    stage: Stage, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(stage.session, "r")
    with monkeypatch.context() as other:
        other.setattr(codec, "SCHEMA", codec.SCHEMA + 1)
        newer = codec.encode(learner.header)
    worker = stage.hire()
    inbox, generation = keys.inbox(FARM, worker.id), keys.generation(FARM, "r")
    stage.next("worker")
    for key in (inbox, generation, generation):
        for payload in (
            b"",
            b"\xc1",
            newer,
            codec.encode(replace(learner.header, run="a//b")),
            codec.encode(Refusal(run="r", reason="none")),
        ):
            stage.session.publish(key, payload)
    learner.announce()
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1]
    warning = f"schema version {codec.SCHEMA + 1}, this side has {codec.SCHEMA}"
    until(lambda: sum(warning in line for line in caplog.messages) == 2)


def test_a_header_that_comes_late_voids_nothing(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    Runner.go.clear()
    learner.send(worker.id, 1)
    until(lambda: Runner.ran)
    learner.send(worker.id, 2)
    learner.header = replace(learner.header, round=learner.header.round - 1)
    learner.announce()
    Runner.go.set()
    assert [indices(stage.results()) for _ in range(2)] == [[1], [2]]


def test_what_is_kept_is_bounded(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inbox, "_MEMORY", 10_000)
    monkeypatch.setattr(workers, "IDLE", 0.05)
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.announce()
    # Together three times as much, and each of the last ones too much by itself
    for i in range(20):
        header = replace(learner.header, run=f"made-up-{i}", mu=np.ones(200 if i < 6 else 2000))
        stage.session.publish(keys.generation(FARM, header.run), codec.encode(header))
    stage.asked(lambda want: want.ignored == {"large": 14})
    for i in range(20):
        header = replace(learner.header, run=f"another-{i}", mu=np.ones(200))
        stage.session.publish(keys.generation(FARM, header.run), codec.encode(header))
    stage.asked(lambda want: "another-19" in want.idle)
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1], "what was crowded out is asked for again"
    headers = [worker.inbox.of(run).header for run in worker.inbox.runs]
    assert sum(header.mu.nbytes for header in headers if header) <= 10_000
    stage.asked(lambda want: want.ignored == {"large": 14})


def test_jobs_of_another_size_are_not_run(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.header = replace(learner.header, mu=np.ones(P + 1))
    learner.send(worker.id, 0)
    until(lambda: "ignored jobs of run r: not 3 parameters" in caplog.text)
    learner.header = replace(learner.header, mu=np.ones(P), round=3)
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1]


def test_a_specification_that_is_not_the_headers_is_not_run(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    learner = Learner(stage.session, "r")
    learner.spec += b" "
    worker = stage.hire()
    learner.send(worker.id, 0)
    until(lambda: "run r does not send its specification; its jobs wait" in caplog.messages)
    learner.spec = learner.spec[:-1]
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1]
    assert Runner.builds == ["r"]


def result_of(stage: Stage, learner: Learner, worker: Worker, index: int) -> Results:
    """The result of a job that is sent again whenever the worker says that it has none."""
    learner.send(worker.id, index)
    while True:
        _, message = stage.next("want", "result of r")
        if isinstance(message, Results) and indices(message) == [index]:
            return message
        if isinstance(message, WorkRequest) and "r" in message.idle:
            learner.send(worker.id, index)


def test_a_false_header_does_not_stall_other_runs(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    for changed in (
        {"round": 2**63 - 1},
        {"incarnation": "zzzz"},
        {"round": 2**63 - 1, "mu": np.zeros(P)},
    ):
        stage.session.publish(
            keys.generation(FARM, "r"),
            codec.encode(replace(learner.header, **changed)),  # type: ignore[arg-type]
        )
        answer = result_of(stage, learner, worker, 1)
        assert (indices(answer), answer.returns.tolist()) == ([1], [6.0])
    learner.header = replace(learner.header, round=3)
    learner.announce()
    assert indices(result_of(stage, learner, worker, 2)) == [2]


def test_jobs_of_a_round_that_no_learner_confirms_are_told_of(
    stage: Stage, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    caplog.set_level(logging.INFO)
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.send(worker.id, 1, round=7)
    until(
        lambda: any(
            line.startswith("run r: jobs of a round that is not announced yet are left out")
            for line in caplog.messages
        )
    )
    assert {record.levelname for record in caplog.records} == {"INFO"}, "it is normal"
    stage.asked(lambda want: want.ignored == {"stale": 1})


def test_learners_that_do_not_answer_cost_a_tenth_of_the_time(stage: Stage) -> None:
    over = threading.Event()
    questions: list[str] = []

    def deaf(run: str) -> bytes:
        questions.append(run)
        over.wait(WAIT)
        return b""

    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.announce()
    with connect((stage.endpoint,), WAIT, lambda: False) as rogue:
        for i in range(30):
            rogue.answer(keys.generation(FARM, f"made-up-{i}"), lambda i=i: deaf(f"made-up-{i}"))
        for i in range(30):
            learner.send(worker.id, 0, run=f"made-up-{i}")
        learner.send(worker.id, 1)
        start = time.monotonic()
        assert indices(stage.results()) == [1]
        assert time.monotonic() - start < 2.0, "thirty questions were waited for"
        stage.asked(lambda want: want.ignored == {"stale": 30})
        over.set()
    assert len(questions) < 5


def test_no_more_jobs_are_kept_than_were_asked_for(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    learner, worker = at_work(stage)
    most = 8 * CAPACITY
    learner.send(worker.id, *range(10, 10 + most))
    learner.send(worker.id, 3)
    until(lambda: stage.queued == 4)
    Runner.go.set()
    assert [indices(stage.results()) for _ in range(4)] == [[0], [1], [2], [3]]
    stage.asked(lambda want: want.ignored == {"large": 1})
