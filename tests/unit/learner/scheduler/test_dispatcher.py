"""The learner's side of the network, against workers that are honest, confused or hostile; no physics."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from farm.errors import RunError
from farm.net import codec, keys
from farm.net.work import Chunk, RoundHeader, Job, Jobs
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.work import Failure, Result, Results, WireTrajectory
from farm.net.session import Session, connect, listen
from learner.run import free_endpoint
from learner.scheduler import attendance
from learner.scheduler import dispatcher as dispatchers
from learner.scheduler.admission import Admission
from learner.scheduler.dispatcher import Dispatcher, Stopped
from learner.scheduler.scheduler import SchedulerConfig

FARM, RUN, STEPS = "try", "r", 3
SPEC = Spec(
    run=RUN, task="none", task_config={"steps": STEPS}, policy_config={}, frequencies=np.empty((0, 8)),
    phases=np.empty(0),
)  # fmt: skip
SHAPES = {"bodies": (2, 7), "joints": (8,), "targets": (8,), "images": (3, 18), "points": (3, 3), "terms": (5,)}
NEWER = codec.encode(
    WorkRequest(worker="a/1", credits=1, idle=(), version="9", assets="a", canary="c", host="h", cores=2),
    codec.SCHEMA + 1,
)
PATIENT = SchedulerConfig(straggler_seconds=60.0)
WAIT = 20.0


def jobs(count: int, rate: str = "none") -> list[Job]:
    return [
        Job(index=i, origin="mu", signs=(1, -1), perturbation=(3, 0, 4, i), rate=rate, eps=np.zeros(2))
        for i in range(count)
    ]


def result(index: int, rollouts: int = 2, steps: int = STEPS, value: float | None = None) -> Result:
    no = np.zeros(rollouts, bool)
    return Result(
        index=index, trajectory=None, returns=np.full(rollouts, float(index) if value is None else value), success=no,
        dropped=no, failed=no, clamped=no,
        traces=np.zeros((rollouts, steps, 54), "<f4"),
    )  # fmt: skip


class Worker:
    """A worker that does what the test says."""

    def __init__(self, session: Session, name: str) -> None:
        self.session, self.name = session, name
        session.subscribe("inbox", keys.inbox(FARM, name))
        session.subscribe("generation", keys.generation(FARM, "*"))
        session.watch("learner", keys.learner_token(FARM, "*"))
        session.token(keys.worker_token(FARM, name))
        self.next("learner")

    def next(self, topic: str) -> bytes:
        while True:
            event = self.session.events.get(timeout=WAIT)
            if event.topic == topic:
                return event.payload

    def chunk(self) -> Chunk:
        return codec.decode(self.next("inbox"), Chunk)

    def want(self, credits: int, *, idle: bool = False) -> None:
        self.say(
            keys.want(FARM, self.name),
            WorkRequest(
                worker=self.name,
                credits=credits,
                idle=(RUN,) if idle else (),
                version="0",
                assets="a",
                canary="c",
                host="h",
                cores=2,
            ),
        )

    def say(self, key: str, message: object) -> None:
        self.session.publish(key, message if isinstance(message, bytes) else codec.encode(message))

    def results(self, chunk: Chunk, *results: Result) -> Results:
        found = results or tuple(result(index) for index in chunk.indices.tolist())
        head = {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round, "worker": self.name}
        return Results.of(found, traces="extremes", **head)

    def answer(self, message: object) -> None:
        self.say(keys.result(FARM, RUN, self.name), message)

    def work(self, count: int) -> list[int]:
        """Answer chunks until so many jobs are done."""
        done: list[int] = []
        while len(done) < count:
            chunk = self.chunk()
            self.answer(self.results(chunk))
            done += chunk.indices.tolist()
        return done


class Learner:
    """A dispatcher, its rounds collected on another thread."""

    def __init__(self, session: Session) -> None:
        self.session, self.stop = session, threading.Event()
        self._pool = ThreadPoolExecutor(1)

    def show(self, ledger: SchedulerConfig = PATIENT, stopped: Callable[[], bool] | None = None) -> Dispatcher:
        join = "farm worker --connect here"
        self.farm = Dispatcher(
            self.session, FARM, SPEC, 9, join, stopped or self.stop.is_set, Admission("a", None), SHAPES, ledger
        )
        return self.farm

    def collect(self, todo: list[Job]) -> "Future[list[Result]]":
        self.farm.begin(0, np.zeros(2), Jobs.of(todo), "extremes")
        return self._pool.submit(self.farm.collect)

    def close(self) -> None:
        self.stop.set()
        self._pool.shutdown()


Hire = Callable[[str], Worker]


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def learner(endpoint: str) -> Iterator[Learner]:
    with listen(endpoint, FARM) as session:
        started = Learner(session)
        yield started
        started.close()


@pytest.fixture
def hire(endpoint: str, learner: Learner) -> Iterator[Hire]:  # noqa: ARG001  the learner has to be there
    with ExitStack() as stack:
        yield lambda name: Worker(stack.enter_context(connect((endpoint,), WAIT, lambda: False)), name)


def indices(found: list[Result]) -> list[int]:
    return [one.index for one in found]


def test_results_come_in_the_jobs_order(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(100)
    for _ in range(3):
        collected = learner.collect(jobs(20))
        worker.work(20)
        found = collected.result(WAIT)
        assert indices(found) == list(range(20))
        assert [one.returns[0] for one in found] == list(range(20))
    assert farm.workers == ("a/1",)
    assert farm.reissued == 0
    assert not farm.ignored


def test_a_round_is_announced(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    farm.begin(7, np.array([1.0, 2.0]), Jobs.of(jobs(1)), "all")
    said = codec.decode(worker.next("generation"), RoundHeader)
    assert (said.run, said.round, said.generation, said.mu.tolist(), said.traces) == (RUN, 1, 7, [1, 2], "all")
    asked = worker.session.ask(keys.generation(FARM, RUN), WAIT)
    assert asked is not None
    assert codec.decode(asked, RoundHeader).incarnation == said.incarnation
    assert worker.session.ask(keys.spec(FARM, RUN), WAIT) == codec.encode(SPEC)


def test_no_more_than_a_worker_wants(learner: Learner, hire: Hire) -> None:
    learner.show(replace(PATIENT, chunk_seconds=100.0))
    worker = hire("a/1")
    worker.want(3)
    collected = learner.collect(jobs(30))
    held: list[int] = []
    done = 0
    while done < 30:
        chunk = worker.chunk()
        held += chunk.indices.tolist()
        assert len(held) <= 3
        while held and (len(held) > 1 or done == 29):
            worker.answer(worker.results(chunk, result(held.pop(0))))
            done += 1
    assert indices(collected.result(WAIT)) == list(range(30))


def test_who_wants_nothing_gets_nothing(learner: Learner, hire: Hire) -> None:
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


def test_messages_that_do_not_count(learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "MAX_BYTES", 100_000)
    farm = learner.show()
    worker = hire("a/1")
    inbox = keys.want(FARM, worker.name)
    for nonsense in (
        b"",
        b"\xc1",
        NEWER,
        WorkRequest(worker="b/1", credits=50, idle=(), version="0", assets="a", canary="c", host="h", cores=2),
    ):
        worker.say(inbox, nonsense)
    worker.want(1)
    collected = learner.collect(jobs(4))
    first = worker.chunk()
    honest = worker.results(first)
    bad = [
        b"", b"no message", b"\x80", b"\0" * 200_000, NEWER,
        worker.results(first, result(0, rollouts=1)), worker.results(first, result(-1)),
        worker.results(first, result(0, steps=2)), worker.results(first, result(4)),
        replace(honest, run="other"), replace(honest, worker="b/1"),
        replace(honest, round=0), replace(honest, incarnation="0" * 16),
        WorkRequest(worker="a/1", credits=1, idle=(), version="0", assets="a", canary="c", host="h", cores=2),
        Failure(run=RUN, incarnation=first.incarnation, round=first.round, worker="a/1", index=99, error="no"),
        Failure(run=RUN, incarnation="gone", round=first.round, worker="a/1", index=0, error="no"),
    ]  # fmt: skip
    for message in bad:
        worker.answer(message)
    assert farm.workers == ("a/1",), "somebody joined by a message of another"
    worker.answer(honest)
    worker.answer(worker.results(first, result(0, value=7.0)))
    worker.work(3)
    found = collected.result(WAIT)
    assert [one.returns.tolist() for one in found] == [[i, i] for i in range(4)]
    assert farm.ignored == {"bad": 2 + 8, "version": 1 + 2, "large": 1, "foreign": 1 + 2, "stale": 3, "doubled": 1}


def test_another_release_in_a_workers_name_does_not_shut_it_out(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(2))
    first = worker.chunk()
    worker.say(keys.want(FARM, worker.name), NEWER)
    worker.answer(worker.results(first))
    worker.work(1)
    assert [one.returns.tolist() for one in collected.result(WAIT)] == [[i, i] for i in range(2)]
    assert farm.ignored == {"version": 1}


def test_made_up_names_are_nobody(learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attendance, "_SOON", 0.0)
    monkeypatch.setattr(dispatchers, "_STATUS", 0.0)
    farm = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(30))
    nobody = WorkRequest(worker="", credits=9, idle=(), version="0", assets="a", canary="c", host="h", cores=2)
    for i in range(3000):
        worker.say(keys.want(FARM, f"nobody/{i}"), replace(nobody, worker=f"nobody/{i}"))
    worker.want(10)
    worker.work(30)
    collected.result(WAIT)
    assert farm.workers == ("a/1",)
    assert [known.worker for known in farm.census()] == ["a/1"]
    collected = learner.collect(jobs(1))
    worker.work(1)
    collected.result(WAIT)
    assert farm.ignored == {"absent": 3000}


def test_a_worker_whose_token_was_missed(learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing tells the learner that the token came: it asks for it."""
    monkeypatch.setattr(learner.session, "watch", lambda *_: None)
    farm = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(4))
    worker.want(10)
    worker.work(4)
    collected.result(WAIT)
    assert farm.workers == ("a/1",)
    assert not farm.ignored


def test_a_trajectory_that_was_asked_for(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1, rate="control"))
    arrays = {name: np.zeros((1, *shape), "<f4") for name, shape in SHAPES.items()}
    good = WireTrajectory(value=0.0, success=False, times=np.zeros(1), **arrays)
    bodies, terms = replace(good, bodies=np.zeros((1, 3, 7), "<f4")), replace(good, terms=np.zeros((1, 1), "<f4"))
    for shown in (None, bodies, terms):
        chunk = worker.chunk()
        worker.answer(worker.results(chunk, replace(result(0), trajectory=shown)))
        worker.answer(Failure(**_head(chunk), worker="a/1", index=0, error="no camera"))
    with pytest.raises(RunError, match="no camera"):
        collected.result(WAIT)
    assert farm.ignored == {"bad": 3}


def test_messages_of_a_round_gone_by(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(5)
    collected = learner.collect(jobs(1))
    first = worker.chunk()
    worker.answer(worker.results(first))
    collected.result(WAIT)
    collected = learner.collect(jobs(1))
    chunk = worker.chunk()
    worker.answer(worker.results(first, result(0, value=-9.0)))
    worker.answer(worker.results(chunk))
    assert collected.result(WAIT)[0].returns[0] == 0.0
    assert farm.ignored == {"stale": 1}


def test_hostile_lines_are_told_of_once(learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    chunk = worker.chunk()
    for _ in range(500):
        worker.answer(b"rubbish")
    worker.answer(worker.results(chunk))
    collected.result(WAIT)
    assert learner.farm.ignored == {"bad": 500}
    assert sum("ignored a message" in line for line in caplog.messages) == 1


def test_a_worker_that_is_gone(endpoint: str, learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    farm = learner.show()
    with connect((endpoint,), WAIT, lambda: False) as session:
        lost = Worker(session, "a/1")
        lost.want(4)
        collected = learner.collect(jobs(8))
        for _ in range(2):
            lost.chunk()
    other = hire("b/1")
    other.want(4)
    assert sorted(other.work(8)) == list(range(8))
    assert indices(collected.result(WAIT)) == list(range(8))
    assert farm.reissued >= 2
    assert farm.workers == ("b/1",)
    assert any(line.startswith("worker a/1 left; ") for line in caplog.messages)
    assert sum("worker a/1 joined" in line for line in caplog.messages) == 1


def test_a_worker_that_lost_its_jobs(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(2)
    collected = learner.collect(jobs(5))
    forgotten = {index for _ in range(2) for index in worker.chunk().indices.tolist()}
    worker.want(2, idle=True)
    assert forgotten <= set(worker.work(5))
    assert indices(collected.result(WAIT)) == list(range(5))
    assert farm.reissued == 2


def test_a_slow_worker_is_helped(learner: Learner, hire: Hire) -> None:
    farm = learner.show(SchedulerConfig(straggler_seconds=0.1))
    slow, fast = hire("a/1"), hire("b/1")
    slow.want(1)
    collected = learner.collect(jobs(2))
    stuck = slow.chunk()
    fast.want(5)
    fast.work(2)
    assert indices(collected.result(WAIT)) == [0, 1]
    assert farm.reissued >= 1
    collected = learner.collect(jobs(1))
    slow.answer(slow.results(stuck))
    fast.work(1)
    collected.result(WAIT)


@pytest.mark.parametrize("workers", [1, 3])
def test_a_job_that_fails_everywhere(learner: Learner, hire: Hire, workers: int) -> None:
    learner.show()
    hands = [hire(f"w{i}/1") for i in range(workers)]
    for hand in hands:
        hand.want(1)
    collected = learner.collect(jobs(1))
    turn: queue.SimpleQueue[None] = queue.SimpleQueue()

    def fail(hand: Worker) -> None:
        while True:
            try:
                event = hand.session.events.get(timeout=0.05)
            except queue.Empty:
                if collected.done():
                    return
                continue
            if event.topic == "inbox":
                chunk = codec.decode(event.payload, Chunk)
                turn.put(None)
                text = f"OverflowError: too much for {hand.name}"
                hand.answer(Failure(**_head(chunk), worker=hand.name, index=int(chunk.indices[0]), error=text))

    threads = [threading.Thread(target=fail, args=(hand,)) for hand in hands]
    for thread in threads:
        thread.start()
    words = r"pair 0 of generation 0 \(perturbation seed \(3, 0, 4, 0\)\) failed .*OverflowError: too much"
    with pytest.raises(RunError, match=words):
        collected.result(WAIT)
    for thread in threads:
        thread.join()
    assert turn.qsize() == 3


def _head(chunk: Chunk) -> dict[str, object]:
    return {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round}


def test_a_failure_is_made_good(learner: Learner, hire: Hire) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    for _ in range(2):
        chunk = worker.chunk()
        worker.answer(Failure(**_head(chunk), worker="a/1", index=0, error="once"))  # type: ignore[arg-type]
    worker.work(1)
    assert indices(collected.result(WAIT)) == [0]


def test_who_does_not_serve_the_run_gets_none_of_it(
    learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    farm = learner.show()
    idle, worker = hire("a/1"), hire("b/1")
    collected = learner.collect(jobs(6))
    idle.want(3)
    chunk = idle.chunk()
    for _ in range(2):
        idle.answer(Failure(**_head(chunk), worker="a/1", index=None, error="not allowed here"))  # type: ignore[arg-type]
    idle.want(3, idle=True)
    worker.want(2)
    worker.work(6)
    assert indices(collected.result(WAIT)) == [0, 1, 2, 3, 4, 5]
    assert farm.workers == ("b/1",)
    assert [text for text in caplog.messages if "not allowed" in text] == [
        "worker a/1 does not serve this run: not allowed here"
    ]


def test_another_release_hears_why_it_gets_nothing(
    learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch
) -> None:
    farm = learner.show()
    other, worker = hire("a/1"), hire("b/1")
    other.session.subscribe("refused", keys.refused(FARM, "a/1"))
    collected = learner.collect(jobs(2))
    with monkeypatch.context() as newer:
        newer.setattr(codec, "SCHEMA", codec.SCHEMA + 1)
        said = codec.encode(
            WorkRequest(worker="a/1", credits=1, idle=(), version="9", assets="a", canary="c", host="h", cores=2)
        )
    other.say(keys.want(FARM, "a/1"), said)
    assert "run the same release on both" in codec.decode(other.next("refused"), Refusal).reason
    worker.want(2)
    worker.work(2)
    collected.result(WAIT)
    assert farm.ignored == {"version": 1}


def test_numbers_of_a_worker_that_did_nothing_bind_nobody(endpoint: str, learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("b/1")
    with connect((endpoint,), WAIT, lambda: False) as session:
        odd = Worker(session, "a/1")
        want = WorkRequest(worker="a/1", credits=1, idle=(), version="0", assets="a", canary="odd", host="h", cores=2)
        collected = learner.collect(jobs(2))
        odd.say(keys.want(FARM, "a/1"), want)
        odd.chunk()
        assert farm.admission.canary == "odd"
    worker.want(2)
    until = time.monotonic() + WAIT
    while not farm.workers or farm.admission.canary != "c":
        assert time.monotonic() < until
        worker.want(2)
        time.sleep(0.05)
    worker.work(2)
    collected.result(WAIT)


def test_patterns_are_nobodys_name(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(1))
    for name in ("**", "*/*", "a/**"):
        want = WorkRequest(worker=name, credits=1, idle=(), version="0", assets="b", canary="c", host="h", cores=2)
        worker.say(keys.want(FARM, name), want)
    worker.want(1)
    worker.work(1)
    collected.result(WAIT)
    assert farm.ignored == {"foreign": 3}


def test_nobody_there_is_said_once(
    learner: Learner, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatchers, "_PATIENCE", 0.0)
    monkeypatch.setattr(dispatchers, "_WAIT", 0.001)
    looks = iter([False] * 20)
    learner.show(stopped=lambda: next(looks, True))
    with pytest.raises(Stopped):
        learner.collect(jobs(1)).result(WAIT)
    said = [line for line in caplog.messages if "no workers" in line]
    assert said == ["no workers; start some with: farm worker --connect here"]


def test_stopped_within_a_second(learner: Learner, hire: Hire) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    worker.chunk()
    begun = time.monotonic()
    learner.stop.set()
    with pytest.raises(Stopped):
        collected.result(WAIT)
    assert time.monotonic() - begun < 1.0
