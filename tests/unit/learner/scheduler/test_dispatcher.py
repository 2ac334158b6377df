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
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.session import Session, connect, free_endpoint, listen
from farm.net.telemetry import RunStatus
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader, WireTrajectory, traced
from learner.scheduler import dispatcher as dispatchers
from learner.scheduler import membership
from learner.scheduler.dispatcher import Dispatcher, Stopped
from learner.scheduler.membership import Admission
from learner.scheduler.round import RoundResults
from learner.scheduler.scheduler import SchedulerConfig

FARM, RUN, TRACE = "try", "r", (3, 4)
SPEC = Spec(run=RUN, task="none", task_config={}, policy="none", policy_config={}, code={})
SHAPES = {"bodies": (2, 7), "actions": (1,), "terms": (2,), "channels/angle": (1,)}
PATIENT = SchedulerConfig(straggler_seconds=60.0)
WAIT = 20.0


def request(worker: str, credits: int = 1, *, idle: bool = False, canary: str = "c") -> WorkRequest:
    runs = (RUN,) if idle else ()
    return WorkRequest(worker=worker, credits=credits, idle=runs, version="0", canary=canary, host="h", cores=2)


NEWER = codec.encode(request("a/1"), codec.SCHEMA + 1)


def jobs(count: int) -> Jobs:
    """Pairs whose index is in their seeds."""
    return Jobs.exploring(np.zeros((count, 2)), (1, -1), [(3, 0, 4, i) for i in range(count)])


class Worker:
    """A worker that does what the test says: a job's returns are its index."""

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
        self.say(keys.want(FARM, self.name), request(self.name, credits, idle=idle))

    def say(self, key: str, message: object) -> None:
        self.session.publish(key, message if isinstance(message, bytes) else codec.encode(message))

    def results(self, chunk: Chunk, *indices: int, value: float | None = None) -> Results:
        """Of all jobs of a chunk, or of these."""
        chosen = sorted(indices or chunk.indices.tolist())
        returns = np.repeat(np.array(chosen, dtype=float) if value is None else value, 2)
        traces = np.zeros((len(traced("extremes", returns, np.ones(len(returns), bool))), *TRACE), "<f4")
        return Results(
            **head(chunk), worker=self.name, jobs=np.array(chosen), returns=returns,
            flags=np.zeros((len(returns), 4), bool), traces=traces, trajectories=(),
        )  # fmt: skip

    def failure(self, chunk: Chunk, index: int | None, error: str) -> Failure:
        return Failure(**head(chunk), worker=self.name, index=index, error=error)

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


def head(chunk: Chunk) -> dict[str, object]:
    return {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round}


class Learner:
    """A dispatcher, its rounds collected on another thread."""

    def __init__(self, session: Session) -> None:
        self.session, self.stop = session, threading.Event()
        self._pool = ThreadPoolExecutor(1)

    def show(self, scheduler: SchedulerConfig = PATIENT, stopped: Callable[[], bool] | None = None) -> Dispatcher:
        join = "farm worker --connect here"
        self.farm = Dispatcher(
            self.session, FARM, SPEC, 9, join, stopped or self.stop.is_set, Admission(None), (TRACE, SHAPES), scheduler
        )
        return self.farm

    def collect(self, todo: Jobs) -> "Future[RoundResults]":
        self.farm.begin(0, np.zeros(2), todo, "extremes")
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
def hire(endpoint: str, learner: Learner) -> Iterator[Hire]:
    with ExitStack() as stack:
        yield lambda name: Worker(stack.enter_context(connect((endpoint,), WAIT, lambda: False)), name)


def done(found: RoundResults) -> list[float]:
    """The returns of each job's first rollout."""
    return found.returns[::2].tolist()


def test_results_come_in_the_jobs_order(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    worker.want(100)
    for _ in range(3):
        collected = learner.collect(jobs(20))
        worker.work(20)
        found = collected.result(WAIT)
        assert found.returns.tolist() == [i for i in range(20) for _ in range(2)]
    assert farm.workers == ("a/1",)
    assert farm.reissued == 0
    assert not farm.ignored


def test_a_round_is_announced(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    farm.begin(7, np.array([1.0, 2.0]), jobs(1), "all")
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
    count = 0
    while count < 30:
        chunk = worker.chunk()
        held += chunk.indices.tolist()
        assert len(held) <= 3
        while held and (len(held) > 1 or count == 29):
            worker.answer(worker.results(chunk, held.pop(0)))
            count += 1
    assert done(collected.result(WAIT)) == list(range(30))


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
    for nonsense in (b"", b"\xc1", NEWER, request("b/1", 50)):
        worker.say(inbox, nonsense)
    worker.want(1)
    collected = learner.collect(jobs(4))
    first = worker.chunk()
    honest = worker.results(first)
    bad = [
        b"", b"no message", b"\x80", b"\0" * 200_000, NEWER,
        replace(honest, returns=honest.returns[:1], flags=honest.flags[:1]), worker.results(first, -1),
        replace(honest, traces=honest.traces[:, 1:]), worker.results(first, 4),
        replace(honest, run="other"), replace(honest, worker="b/1"),
        replace(honest, round=0), replace(honest, incarnation="0" * 16),
        request("a/1"), worker.failure(first, 99, "no"), replace(worker.failure(first, 0, "no"), incarnation="gone"),
    ]  # fmt: skip
    for message in bad:
        worker.answer(message)
    assert farm.workers == ("a/1",), "somebody joined by a message of another"
    worker.answer(honest)
    worker.answer(worker.results(first, 0, value=7.0))
    worker.work(3)
    found = collected.result(WAIT)
    assert done(found) == list(range(4))
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
    assert done(collected.result(WAIT)) == [0, 1]
    assert farm.ignored == {"version": 1}


def test_made_up_names_are_nobody(learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership, "_SOON", 0.0)
    monkeypatch.setattr(dispatchers, "_STATUS", 0.0)
    farm = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(30))
    for i in range(500):
        worker.say(keys.want(FARM, f"nobody/{i}"), request(f"nobody/{i}", 9))
    worker.want(10)
    worker.work(30)
    collected.result(WAIT)
    assert farm.workers == ("a/1",)
    assert [known.worker for known in farm.census()] == ["a/1"]
    collected = learner.collect(jobs(1))
    worker.work(1)
    collected.result(WAIT)
    assert farm.ignored == {"absent": 500}


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
    collected = learner.collect(Jobs.mean("control", [None]))
    arrays = {name: np.zeros((1, *shape), "<f4") for name, shape in SHAPES.items() if "/" not in name}
    angle = {"angle": np.ones((1, 1), "<f4")}
    good = WireTrajectory(value=0.5, success=False, times=np.zeros(1), channels=angle, **arrays)
    wrong = [(), (replace(good, bodies=np.zeros((1, 3, 7), "<f4")),), (replace(good, channels={}),), (good, good)]
    chunk = worker.chunk()
    said = Results(
        **head(chunk), worker="a/1", jobs=np.zeros(1, "<i8"), returns=np.ones(1), flags=np.zeros((1, 4), bool),
        traces=np.zeros((0, *TRACE), "<f4"), trajectories=(good,),
    )  # fmt: skip
    for shown in wrong:
        worker.answer(replace(said, trajectories=shown))
    worker.answer(said)
    found = collected.result(WAIT).trajectory(0)
    assert found is not None
    assert (found.value, found.channels["angle"].tolist()) == (0.5, [[1.0]])
    assert farm.ignored == {"bad": 4}


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
    worker.answer(worker.results(first, 0, value=-9.0))
    worker.answer(worker.results(chunk))
    assert collected.result(WAIT).returns[0] == 0.0
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
    assert done(collected.result(WAIT)) == list(range(8))
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
    assert done(collected.result(WAIT)) == list(range(5))
    assert farm.reissued == 2


def test_a_slow_worker_is_helped(learner: Learner, hire: Hire) -> None:
    farm = learner.show(SchedulerConfig(straggler_seconds=0.1))
    slow, fast = hire("a/1"), hire("b/1")
    slow.want(1)
    collected = learner.collect(jobs(2))
    stuck = slow.chunk()
    fast.want(5)
    fast.work(2)
    assert done(collected.result(WAIT)) == [0, 1]
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
                hand.answer(hand.failure(chunk, 0, text))

    threads = [threading.Thread(target=fail, args=(hand,)) for hand in hands]
    for thread in threads:
        thread.start()
    words = r"job 0 of generation 0 \(seed \(3, 0, 4, 0\)\) failed .*OverflowError: too much"
    with pytest.raises(RunError, match=words):
        collected.result(WAIT)
    for thread in threads:
        thread.join()
    assert turn.qsize() == 3


def test_a_failure_is_made_good(learner: Learner, hire: Hire) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    for _ in range(2):
        chunk = worker.chunk()
        worker.answer(worker.failure(chunk, 0, "once"))
    worker.work(1)
    assert done(collected.result(WAIT)) == [0]


def test_who_does_not_serve_the_run_gets_none_of_it(
    learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    farm = learner.show()
    idle, worker = hire("a/1"), hire("b/1")
    collected = learner.collect(jobs(6))
    idle.want(3)
    chunk = idle.chunk()
    for _ in range(2):
        idle.answer(idle.failure(chunk, None, "not allowed here"))
    idle.want(3, idle=True)
    worker.want(2)
    worker.work(6)
    assert done(collected.result(WAIT)) == [0, 1, 2, 3, 4, 5]
    assert farm.workers == ("b/1",)
    assert [text for text in caplog.messages if "not allowed" in text] == [
        "worker a/1 does not serve this run: not allowed here"
    ]


def test_another_release_hears_why_it_gets_nothing(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    other, worker = hire("a/1"), hire("b/1")
    other.session.subscribe("refused", keys.refused(FARM, "a/1"))
    collected = learner.collect(jobs(2))
    other.say(keys.want(FARM, "a/1"), NEWER)
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
        collected = learner.collect(jobs(2))
        odd.say(keys.want(FARM, "a/1"), request("a/1", canary="odd"))
        odd.chunk()
        assert farm.admission.canary == "odd"
    chunks: list[Chunk] = []
    while not chunks:  # refused, until the learner has seen the other one leave
        worker.want(2)
        came = worker.session.events.waiting(0.05)
        chunks = [codec.decode(event.payload, Chunk) for event in came if event.topic == "inbox"]
    for chunk in chunks:
        worker.answer(worker.results(chunk))
    worker.work(2 - sum(map(len, chunks)))
    collected.result(WAIT)
    assert farm.admission.canary == "c"


def test_who_asks_hears_how_the_run_is_doing(learner: Learner, hire: Hire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatchers, "_STATUS", 0.0)
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
    while (said := status()).open != 1:
        assert time.monotonic() < until
    assert (said.run, said.generation, said.generations, said.refused) == (RUN, 0, 9, 1)
    assert [(one.worker, one.rollouts, one.canary) for one in said.workers] == [("a/1", 4, "c")]
    learner.stop.set()
    with pytest.raises(Stopped):
        collected.result(WAIT)


def test_patterns_are_nobodys_name(learner: Learner, hire: Hire) -> None:
    farm = learner.show()
    worker = hire("a/1")
    collected = learner.collect(jobs(1))
    for name in ("**", "*/*", "a/**"):
        worker.say(keys.want(FARM, name), request(name))
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
