"""The learner's side of the network, against workers that are honest or confused; no physics."""

import logging
import queue
import time
from dataclasses import replace

import numpy as np
import pytest
from doubles import (
    FARM,
    PATIENT,
    RUN,
    SHAPES,
    SPEC,
    TRACE,
    WAIT,
    Hire,
    Learner,
    Worker,
    done,
    head,
    jobs,
)

from farm.errors import RunError
from farm.net import codec, keys
from farm.net.session import Session, connect
from farm.net.telemetry import RunStatus
from farm.net.work import Chunk, Jobs, Results, RoundHeader
from farm.sim.trajectory import Trajectory
from learner.pool import pool as pools
from learner.pool import status as answers
from learner.pool.pool import Stopped
from learner.pool.scheduler import SchedulerConfig


def test_results_come_in_the_jobs_order(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    worker = hire("a/1")
    worker.want(100)
    for _ in range(3):
        collected = learner.collect(jobs(20))
        worker.work(20)
        results = collected.result(WAIT)
        assert results.returns.tolist() == [i for i in range(20) for _ in range(2)]
    assert pool.workers == ("a/1",)
    assert pool.reissued == 0
    assert not pool.notices.ignored


def test_a_round_is_announced(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    worker = hire("a/1")
    pool.begin(7, np.array([1.0, 2.0]), jobs(1), "all")
    header = codec.decode(worker.next("generation"), RoundHeader)
    assert (header.run, header.round, header.generation, header.mu.tolist(), header.traces) == (
        RUN,
        1,
        7,
        [1, 2],
        "all",
    )
    reply = worker.session.ask(keys.generation(FARM, RUN), WAIT)
    assert reply is not None
    assert codec.decode(reply, RoundHeader).incarnation == header.incarnation
    assert worker.session.ask(keys.spec(FARM, RUN), WAIT) == codec.encode(SPEC)


def test_no_more_than_a_worker_wants(learner: Learner, hire: Hire) -> None:
    learner.show(replace(PATIENT, chunk_seconds=100.0))
    worker = hire("a/1")
    worker.want(3)
    collected = learner.collect(jobs(30))
    load: list[int] = []
    count = 0
    while count < 30:
        chunk = worker.chunk()
        load += chunk.indices.tolist()
        assert len(load) <= 3
        while load and (len(load) > 1 or count == 29):
            worker.answer(worker.results(chunk, load.pop(0)))
            count += 1
    assert done(collected.result(WAIT)) == list(range(30))


def test_a_worker_without_credits_gets_no_jobs(learner: Learner, hire: Hire) -> None:
    learner.show()
    lazy, eager = hire("a/1"), hire("b/1")
    lazy.want(0)
    eager.want(4)
    collected = learner.collect(jobs(6))
    eager.work(6)
    collected.result(WAIT)
    inbox = [event for event in iter(lambda: _next(lazy.session), None) if event.topic == "inbox"]
    assert inbox == []


def _next(session: Session):
    try:
        return session.events.get()
    except queue.Empty:
        return None


def test_a_worker_whose_token_was_missed(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing tells the learner that the token came: it asks for it."""
    monkeypatch.setattr(learner.session, "watch", lambda *_: None)
    pool = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(4))
    worker.want(10)
    worker.work(4)
    collected.result(WAIT)
    assert pool.workers == ("a/1",)
    assert not pool.notices.ignored


def test_a_trajectory_that_was_asked_for(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(Jobs.mean("control", [None]))
    arrays = {
        name: np.zeros((1, *shape), "<f4") for name, shape in SHAPES.items() if "/" not in name
    }
    angle = {"angle": np.ones((1, 1), "<f4")}
    good = Trajectory(value=0.5, success=False, times=np.zeros(1), channels=angle, **arrays)
    wrong = [
        (),
        (replace(good, bodies=np.zeros((1, 3, 7), "<f4")),),
        (replace(good, channels={}),),
        (good, good),
    ]
    chunk = worker.chunk()
    answer = Results(
        **head(chunk),
        worker="a/1",
        jobs=np.zeros(1, "<i8"),
        returns=np.ones(1),
        flags=np.zeros((1, 4), bool),
        steps=np.ones(1, "<i8"),
        traces=np.zeros((0, *TRACE), "<f4"),
        trajectories=(good,),
    )
    for trajectories in wrong:
        worker.answer(replace(answer, trajectories=trajectories))
    worker.answer(answer)
    trajectory = collected.result(WAIT).trajectory(0)
    assert trajectory is not None
    assert (trajectory.value, trajectory.channels["angle"].tolist()) == (0.5, [[1.0]])
    assert pool.notices.ignored == {"bad": 4}


def a_round_of_one_job(learner: Learner, worker: Worker) -> Chunk:
    """Collect a job that a worker has answered."""
    worker.want(5)
    collected = learner.collect(jobs(1))
    chunk = worker.chunk()
    worker.answer(worker.results(chunk))
    collected.result(WAIT)
    return chunk


def test_messages_of_a_round_gone_by(learner: Learner, hire: Hire) -> None:
    pool, worker = learner.show(), hire("a/1")
    first = a_round_of_one_job(learner, worker)
    collected = learner.collect(jobs(1))
    chunk = worker.chunk()
    worker.answer(worker.results(first, 0, value=-9.0))
    worker.answer(worker.results(chunk))
    assert collected.result(WAIT).returns[0] == 0.0
    assert pool.notices.ignored == {"stale": 1}


def test_a_late_copy_of_a_worker_that_has_nothing_to_do_any_more(
    learner: Learner, hire: Hire
) -> None:
    pool, worker = learner.show(), hire("a/1")
    first = a_round_of_one_job(learner, worker)
    worker.want(0)
    collected = learner.collect(jobs(1))
    other = hire("b/1")
    other.want(5)
    chunk = other.chunk()
    worker.answer(worker.results(first))
    until = time.monotonic() + WAIT
    # Two sessions: nothing orders their answers
    while not pool.notices.ignored and time.monotonic() < until:
        other.session.ask(keys.status(FARM, RUN), 0.1)
    other.answer(other.results(chunk))
    collected.result(WAIT)
    assert pool.notices.ignored == {"stale": 1}


def test_a_worker_that_is_gone(
    endpoint: str, learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    pool = learner.show()
    with connect((endpoint,), WAIT, lambda: False) as session:
        worker = Worker(session, "a/1")
        worker.want(4)
        collected = learner.collect(jobs(8))
        for _ in range(2):
            worker.chunk()
    other = hire("b/1")
    other.want(4)
    assert sorted(other.work(8)) == list(range(8))
    assert done(collected.result(WAIT)) == list(range(8))
    assert pool.reissued >= 2
    assert pool.workers == ("b/1",)
    assert any(line.startswith("worker a/1 left; ") for line in caplog.messages)
    assert sum("worker a/1 joined" in line for line in caplog.messages) == 1


def test_a_worker_that_lost_its_jobs(learner: Learner, hire: Hire) -> None:
    pool = learner.show()
    worker = hire("a/1")
    worker.want(2)
    collected = learner.collect(jobs(5))
    forgotten = {index for _ in range(2) for index in worker.chunk().indices.tolist()}
    worker.want(2, idle=True)
    assert forgotten <= set(worker.work(5))
    assert done(collected.result(WAIT)) == list(range(5))
    assert pool.reissued == 2


def test_a_slow_worker_is_helped(learner: Learner, hire: Hire) -> None:
    pool = learner.show(SchedulerConfig(straggler_seconds=0.1))
    slow, fast = hire("a/1"), hire("b/1")
    slow.want(1)
    collected = learner.collect(jobs(2))
    stuck = slow.chunk()
    fast.want(5)
    fast.work(2)
    assert done(collected.result(WAIT)) == [0, 1]
    assert pool.reissued >= 1
    collected = learner.collect(jobs(1))
    slow.answer(slow.results(stuck))
    fast.work(1)
    collected.result(WAIT)


def test_a_status_query_is_answered(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers, "_PERIOD", 0.0)
    learner.show()
    worker, idle = hire("a/1"), hire("b/1")
    collected = learner.collect(jobs(3))
    idle.want(1)
    idle.answer(idle.failure(idle.chunk(), None, "not allowed here"))
    worker.want(1)
    worker.work(2)
    worker.chunk()

    def status() -> RunStatus:
        payload = worker.session.ask(keys.status(FARM, RUN), WAIT)
        assert payload is not None
        return codec.decode(payload, RunStatus)

    until = time.monotonic() + WAIT
    while (reply := status()).open != 1:
        assert time.monotonic() < until
    assert (reply.run, reply.generation, reply.generations, reply.refused) == (RUN, 0, 9, 1)
    assert [(one.worker, one.rollouts, one.fingerprint) for one in reply.workers] == [
        ("a/1", 4, "c")
    ]
    learner.stop.set()
    with pytest.raises(Stopped):
        collected.result(WAIT)


def test_missing_workers_are_reported_once(
    learner: Learner, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "_PATIENCE", 0.0)
    monkeypatch.setattr(pools, "_WAIT", 0.001)
    looks = iter([False] * 20)
    learner.show(stopped=lambda: next(looks, True))
    with pytest.raises(Stopped):
        learner.collect(jobs(1)).result(WAIT)
    lines = [line for line in caplog.messages if "no workers" in line]
    assert lines == ["no workers; start some with: farm worker --connect here"]


def test_stopped_within_a_second(learner: Learner, hire: Hire) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    worker.chunk()
    start = time.monotonic()
    learner.stop.set()
    with pytest.raises(Stopped):
        collected.result(WAIT)
    assert time.monotonic() - start < 1.0


def test_the_caller_sees_a_round_before_the_user_s_stop_ends_it(learner: Learner) -> None:
    pool = learner.show(stopped=lambda: True)
    pool.begin(0, np.zeros(2), jobs(1), "extremes")
    progress = pool.progress()
    next(progress)  # here a learner saves which hosts are expelled
    with pytest.raises(Stopped):
        next(progress)


def test_a_run_whose_own_workers_are_all_refused_ends(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "_PATIENCE", 0.0)
    learner.show(join=None, fingerprint="of another machine")
    worker = hire("a/1")
    collected = learner.collect(jobs(1))
    worker.want(1)
    with pytest.raises(
        RunError, match="no worker takes part: its machine rounds differently .* --any-rounding"
    ):
        collected.result(WAIT)


def test_a_run_whose_own_workers_cannot_build_the_task_ends(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "_PATIENCE", 0.0)
    learner.show(join=None)
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    worker.answer(worker.failure(worker.chunk(), None, "ValueError: no mesh.stl"))
    with pytest.raises(RunError, match=r"no worker takes part: ValueError: no mesh\.stl"):
        collected.result(WAIT)
