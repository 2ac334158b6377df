"""A worker and a learner that follows a script: who says what when, what is served, and what is ignored."""

import hashlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from farm import plugins
from farm.arrays import FloatArray
from farm.errors import ConfigError, UnservedError
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.session import Session, connect, free_endpoint, listen
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader, Simulated
from farm.rollouts import SIMULATION
from farm.sim.engines import CAPACITY
from workers import worker as workers
from workers.worker import Worker, WorkerConfig

FARM, P, WAIT = "try", 3, 20.0
BEGINNING = Spec(run="", task="made-up", task_config={}, policy="none", policy_config={}, code={})


class Runner:
    """Simulates nothing; a rollout's return is the sum of its parameters."""

    go: ClassVar[threading.Event]
    made: ClassVar[list[str]]
    ran: ClassVar[list[str]]

    def __init__(self, name: str, policy: Any, make: Callable[..., Any]) -> None:
        self.name, self.policy = name, policy
        self.made.append(name)
        assert callable(make)

    def run(self, mu: FloatArray, jobs: Jobs, traces: str) -> Simulated:
        self.ran.append(self.name)
        self.go.wait(WAIT)
        if 13 in jobs.indices:
            raise ArithmeticError("thirteen")
        returns = jobs.theta(mu).sum(axis=1)
        shown = np.zeros((len(returns) if traces == "all" else 0, 1, 2), "<f4")
        return Simulated(returns, np.zeros((len(returns), 4), bool), shown, ())

    def close(self) -> None:
        pass


def served(spec: Spec, files: tuple[Path, ...]) -> tuple[str, Any]:
    assert files == ()
    if spec.task == "broken":
        raise RuntimeError("no such\n  machine")
    if spec.task == "unknown":
        raise UnservedError("not here")
    return spec.run, SimpleNamespace(size=P)


class Learner:
    """One run as a learner shows it; says only what the test says."""

    def __init__(self, session: Session, run: str, spec: Spec = BEGINNING) -> None:
        self.session, self.run, self.asked = session, run, Counter[str]()
        self.spec = codec.encode(replace(spec, run=run))
        self.header = RoundHeader(
            run=run, incarnation="first", round=2, generation=0, spec=hashlib.sha256(self.spec).hexdigest(),
            traces="all", mu=np.ones(P),
        )  # fmt: skip
        session.subscribe(f"result of {run}", keys.result(FARM, run, "**"))
        session.answer(keys.spec(FARM, run), lambda: self._say("spec", self.spec))
        session.answer(keys.generation(FARM, run), lambda: self._say("generation", codec.encode(self.header)))
        session.token(keys.learner_token(FARM, run))

    def _say(self, what: str, payload: bytes) -> bytes:
        self.asked[what] += 1
        return payload

    def announce(self) -> None:
        self.session.publish(keys.generation(FARM, self.run), codec.encode(self.header))

    def send(self, worker: str, *indices: int, **changed: object) -> None:
        """Jobs of one rollout each, whose eps are their index."""
        header = self.header
        jobs = Jobs.exploring(np.array([np.full(len(header.mu), float(i)) for i in indices]), (1,), None)
        jobs.table[:, 0] = indices
        values = {"run": self.run, "incarnation": header.incarnation, "round": header.round}
        chunk = Chunk.carrying(jobs, **(values | changed))  # type: ignore[arg-type]
        self.session.publish(keys.inbox(FARM, worker), codec.encode(chunk))


class Stage:
    """A farm's network with a place for learners, and one worker at a time on a thread."""

    def __init__(self, session: Session, endpoint: str) -> None:
        self.session, self._endpoint = session, endpoint
        self._stop, self._open = threading.Event(), ExitStack()
        self._hired: list[Worker] = []
        session.subscribe("want", keys.want(FARM, "**"))
        session.watch("worker", keys.worker_token(FARM, "**"))

    def hire(self, **changed: Any) -> Worker:
        config = WorkerConfig(connect=(self._endpoint,), farm=FARM, name="w", **changed)
        session = self._open.enter_context(connect((self._endpoint,), WAIT, lambda: False))
        worker = Worker(config, session)
        self._hired.append(worker)
        worker.join()
        thread = threading.Thread(target=self._work, args=(worker,))
        thread.start()
        self._open.callback(thread.join)
        until(lambda: self.session.present(keys.worker_token(FARM, worker.id), 1.0))  # before, it could not be reached
        return worker

    def _work(self, worker: Worker) -> None:
        while not self._stop.is_set():
            worker.turn()
        worker.leave()

    def next(self, *topics: str, kind: type[object] | None = None) -> tuple[str, object]:
        """The next message of these topics: its key's tail and what it says."""
        while True:
            event = self.session.events.get(timeout=WAIT)
            if event.topic not in topics:
                continue
            if event.topic == "worker":
                return keys.tail(event.key, keys.worker_token(FARM, "")), event.alive
            return event.topic, codec.decode(event.payload, kind or (WorkRequest if event.topic == "want" else Results))

    def results(self, *runs: str) -> Results:
        _, said = self.next(*(f"result of {run}" for run in runs or ("r",)))
        assert isinstance(said, Results)
        return said

    def failure(self) -> Failure:
        _, said = self.next("result of r", kind=Failure)
        assert isinstance(said, Failure)
        return said

    def let_go(self) -> None:
        """Ask the worker to leave, and wake it."""
        self._stop.set()
        for worker in self._hired:
            worker._session.events.put(Event("refused", "", b""))

    def close(self) -> None:
        self.let_go()
        Runner.go.set()
        self._open.close()


@pytest.fixture
def real() -> Iterator[Stage]:
    """Whose workers simulate."""
    Runner.go, Runner.made, Runner.ran = threading.Event(), [], []
    Runner.go.set()
    endpoint = free_endpoint()
    with listen(endpoint, FARM) as session:
        opened = Stage(session, endpoint)
        yield opened
        opened.close()


@pytest.fixture
def stage(real: Stage, monkeypatch: pytest.MonkeyPatch) -> Stage:
    monkeypatch.setattr(workers, "served", served)
    monkeypatch.setattr(workers, "Runner", Runner)
    return real


def until(event: Callable[[], object]) -> None:
    end = time.monotonic() + WAIT
    while not event():
        assert time.monotonic() < end
        threading.Event().wait(0.005)


def indices(results: Results) -> list[int]:
    return results.jobs.tolist()


@pytest.mark.parametrize("_", range(3))
def test_whoever_sees_a_worker_can_reach_it(stage: Stage, _: int) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    name, alive = stage.next("worker")
    assert (name, alive) == (worker.id, True)
    learner.announce()
    learner.send(worker.id, 0)
    assert indices(stage.results()) == [0]


def test_it_says_what_it_wants(stage: Stage) -> None:
    Learner(stage.session, "r")
    worker = stage.hire()
    _, want = stage.next("want")
    assert isinstance(want, WorkRequest)
    assert (want.worker, want.credits, want.idle) == (worker.id, 2 * CAPACITY, ())


def test_it_asks_for_what_it_has_not_heard(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    for first in (0, 2):
        learner.send(worker.id, first, first + 1)
        answer = stage.results()
        assert (answer.run, answer.incarnation, answer.round, answer.worker) == ("r", "first", 2, worker.id)
        assert indices(answer) == [first, first + 1]
        assert answer.returns.tolist() == [3.0 + 3 * first, 6.0 + 3 * first]
    assert learner.asked == {"generation": 1, "spec": 1}
    assert Runner.made == ["r"]


def test_chunks_of_rounds_gone_by_are_dropped(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.announce()
    learner.send(worker.id, 0, round=1)
    learner.send(worker.id, 1, incarnation="before")
    learner.send(worker.id, 2)
    assert indices(stage.results()) == [2]


def at_work(stage: Stage) -> tuple[Learner, Worker]:
    """A worker in the middle of job 0, held up there, with jobs 1 and 2 on their way."""
    learner, worker = Learner(stage.session, "r"), stage.hire()
    stage.next("want")
    Runner.go.clear()
    learner.send(worker.id, 0)
    until(lambda: Runner.ran)
    for index in (1, 2):
        learner.send(worker.id, index)
    return learner, worker


def test_work_of_an_old_round_is_given_up(stage: Stage) -> None:
    learner, worker = at_work(stage)
    learner.header = replace(learner.header, round=3)
    learner.announce()
    learner.send(worker.id, 3)
    until(lambda: len(worker._session.events) == 4)
    Runner.go.set()
    assert [(indices(said), said.round) for said in (stage.results(), stage.results())] == [([0], 2), ([3], 3)]


def test_two_runs_in_turn(stage: Stage) -> None:
    learners = [Learner(stage.session, run) for run in ("a", "b")]
    worker = stage.hire()
    for _ in learners:
        stage.next("want")
    Runner.go.clear()
    learners[0].send(worker.id, 0)
    until(lambda: Runner.ran)
    for learner, sent in zip(learners, ((1, 2), (0, 1, 2)), strict=True):
        for index in sent:
            learner.send(worker.id, index)
    until(lambda: len(worker._session.events) == 5)
    Runner.go.set()
    answers = [stage.results("a", "b") for _ in range(6)]
    assert Runner.ran == ["a", "b", "a", "b", "a", "b"]
    assert [indices(said) for said in answers if said.run == "b"] == [[0], [1], [2]]
    assert Runner.made == ["a", "b"]


def test_a_learner_that_leaves_takes_its_work_along(stage: Stage) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.send(worker.id, 0)
    stage.results()
    assert list(worker._runs) == ["r"]
    stage.session._tokens.pop().undeclare()
    until(lambda: not worker._runs)


def test_an_idle_worker_says_so(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    Learner(stage.session, "r")
    stage.hire()
    said = [stage.next("want")[1] for _ in range(3)]
    assert [want.idle for want in said if isinstance(want, WorkRequest)] == [(), ("r",), ("r",)]


def test_what_got_lost_of_one_run_is_noticed_while_another_keeps_it_busy(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "IDLE", 0.05)
    busy, _ = Learner(stage.session, "busy"), Learner(stage.session, "lost")
    worker = stage.hire()
    busy.send(worker.id, 0)
    while True:
        _, said = stage.next("result of busy", "want")
        if isinstance(said, Results):
            busy.send(worker.id, 0)
        elif isinstance(said, WorkRequest) and "lost" in said.idle:
            break


def test_a_worker_that_leaves_hands_back(stage: Stage) -> None:
    learner, worker = at_work(stage)
    until(lambda: len(worker._session.events) == 2)
    stage.let_go()
    Runner.go.set()
    said: list[object] = []
    while len(said) < 2:
        _, message = stage.next("result of r", "want")
        if not isinstance(message, WorkRequest) or message.credits == 0:
            said.append(message)
    said.sort(key=lambda message: isinstance(message, WorkRequest))
    done, want = said
    assert isinstance(done, Results)
    assert isinstance(want, WorkRequest)
    assert indices(done) == [0], "what it has begun is done"
    assert want.idle == ("r",)


def test_a_task_it_does_not_know(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r", replace(BEGINNING, task="unknown"))
    worker = stage.hire()
    for _ in range(2):
        learner.send(worker.id, 4, 5)
        said = stage.failure()
        assert said.index is None, "it is not the job"
        assert said.error == "not here"
    assert caplog.messages == ["cannot serve run r: not here"]
    assert caplog.records[0].exc_info in (None, False)
    assert learner.asked["spec"] == 1


def test_a_task_it_cannot_build(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r", replace(BEGINNING, task="broken"))
    worker = stage.hire()
    learner.send(worker.id, 0)
    assert stage.failure().error == "RuntimeError: no such machine"
    assert caplog.messages[0].startswith("cannot serve run r: no such")
    assert caplog.records[0].exc_info


def test_a_job_that_fails_does_not_take_others_along(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.send(worker.id, 12, 13, 14)
    assert indices(stage.results()) == [12]
    failed = stage.failure()
    assert (failed.index, failed.error) == (13, "ArithmeticError: thirteen")
    assert (failed.run, failed.incarnation, failed.round, failed.worker) == ("r", "first", 2, worker.id)
    assert indices(stage.results()) == [14]
    assert [r.levelno for r in caplog.records] == [logging.ERROR]


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
    said = f"schema version {codec.SCHEMA + 1}, this side speaks {codec.SCHEMA}"
    until(lambda: sum(said in line for line in caplog.messages) == 2)


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
    monkeypatch.setattr(workers, "_MEMORY", 10_000)
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.announce()
    for i in range(20):  # together three times as much, and each of the last ones too much by itself
        header = replace(learner.header, run=f"made-up-{i}", mu=np.ones(200 if i < 6 else 2000))
        stage.session.publish(keys.generation(FARM, header.run), codec.encode(header))
    until(lambda: worker._ignored["large"] == 14)
    for i in range(20):
        header = replace(learner.header, run=f"another-{i}", mu=np.ones(200))
        stage.session.publish(keys.generation(FARM, header.run), codec.encode(header))
    until(lambda: "another-19" in worker._runs)
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1], "what was crowded out is asked for again"
    kept = [run.header for run in worker._runs.values() if run.header]
    assert sum(header.mu.nbytes for header in kept) <= 10_000
    monkeypatch.setattr(workers, "IDLE", 0.0)
    while True:
        _, want = stage.next("want")
        assert isinstance(want, WorkRequest)
        if want.ignored == {"large": 14}:
            break


def test_jobs_of_another_size_are_not_run(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r")
    worker = stage.hire()
    learner.header = replace(learner.header, mu=np.ones(P + 1))
    learner.send(worker.id, 0)
    until(lambda: "ignored jobs of run r: not 3 parameters" in caplog.text)
    learner.header = replace(learner.header, mu=np.ones(P), round=3)
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1]


def test_a_refusal_is_told_of_once(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner, worker = Learner(stage.session, "r"), stage.hire()
    for _ in range(3):
        refusal = codec.encode(Refusal(run="r", reason="its machine\nrounds"))
        stage.session.publish(keys.refused(FARM, worker.id), refusal)
    learner.send(worker.id, 0)
    stage.results()
    assert caplog.messages == ["run r does not take this worker: its machine rounds"]


def test_a_specification_that_is_not_the_headers_is_not_run(stage: Stage, caplog: pytest.LogCaptureFixture) -> None:
    learner = Learner(stage.session, "r")
    learner.spec += b" "
    worker = stage.hire()
    learner.send(worker.id, 0)
    until(lambda: "run r does not tell what it simulates; its jobs wait" in caplog.messages)
    learner.spec = learner.spec[:-1]
    learner.send(worker.id, 1)
    assert indices(stage.results()) == [1]
    assert Runner.made == ["r"]


# ---------------------------------------------------------------- classes in files

POLE = """
import numpy as np
import farm

class Pole(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator><motor joint="j"/></actuator></mujoco>'''
    steps = 4

    def reward(self, sim, action):
        return np.cos(sim.qpos[:, 0])
"""


def pole(file: Path) -> Spec:
    """What a learner says of the task in that file."""
    found, policy = plugins.find("tasks", f"{file}:Pole"), plugins.find("policies", "kernel")
    code = {"task": found.digest(), "policy": policy.digest(), "simulation": plugins.code_digest(SIMULATION)}
    files = {"model.xml": found.target.xml}
    return replace(BEGINNING, task=found.wire, policy="kernel", code=code, files=files)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "pole.py"
    path.write_text(POLE)
    return path


def test_a_class_in_a_file_is_served_by_who_was_told_to(real: Stage, file: Path, tmp_path: Path) -> None:
    learner = Learner(real.session, "r", pole(file))
    learner.header = replace(learner.header, mu=np.ones(2))
    here = tmp_path / "elsewhere" / "pole.py"
    here.parent.mkdir()
    here.write_text(POLE)
    worker = real.hire(allow_file=(here,))
    learner.send(worker.id, 0, 1)
    returns = real.results().returns
    assert len(returns) == 2
    assert (returns > 3.9).all(), "four steps of at most 1"


def test_a_class_in_a_file_is_refused_by_who_was_not(real: Stage, file: Path) -> None:
    learner = Learner(real.session, "r", pole(file))
    worker = real.hire()
    learner.send(worker.id, 0)
    said = real.failure()
    assert said.index is None
    assert said.error.startswith("pole.py is a file on the learner's machine: copy it here")


def test_settings_that_make_no_sense() -> None:
    for values, words in (
        ({"backend": "gpu"}, "unknown backend 'gpu'; known are cpu"),
        ({"allow_file": (Path("nowhere.py"),)}, "--allow-file nowhere.py: there is no such file"),
        ({"name": "a/b"}, "worker 'a/b' is not a name"),
        ({"farm": "*"}, r"farm '\*' is not a name"),
        ({"connect": ("tcp/here",)}, "is not of the form tcp/HOST:PORT"),
        ({"timeout": float("nan")}, "timeout is nan"),
    ):
        with pytest.raises(ConfigError, match=words):
            WorkerConfig(**values)  # type: ignore[arg-type]
    assert keys.checked("worker", WorkerConfig().name)
