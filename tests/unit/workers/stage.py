"""A test stage for one worker: learners that follow a script, and a task that simulates nothing."""

import hashlib
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from made import spec

from farm.arrays import FloatArray
from farm.errors import UnservedError
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Spec, WorkRequest
from farm.net.session import Session, connect
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader, Simulated
from workers.config import WorkerConfig
from workers.worker import Worker

FARM, P, WAIT = "try", 3, 20.0
BEGINNING = spec(run="")


class Runner:
    """Simulates nothing; a rollout's return is the sum of its parameters."""

    go: ClassVar[threading.Event]
    builds: ClassVar[list[str]]
    ran: ClassVar[list[str]]

    def __init__(self, name: str, policy: Any, make: Callable[..., Any], *, exact: bool) -> None:
        assert exact
        self.name, self.size = name, policy.size
        self.builds.append(name)
        assert callable(make)

    def run(
        self,
        mu: FloatArray,
        jobs: Jobs,
        traces: str,
        normaliser: FloatArray | None = None,
        *,
        terms: bool,
    ) -> Simulated:
        self.ran.append(self.name)
        self.go.wait(WAIT)
        if 13 in jobs.indices:
            raise ArithmeticError("thirteen")
        returns = jobs.theta(mu).sum(axis=1)
        trace = np.zeros((len(returns) if traces == "all" else 0, 1, 2), "<f4")
        flags, steps = np.zeros((len(returns), 4), bool), np.ones(len(returns), "<i8")
        return Simulated(returns=returns, flags=flags, steps=steps, traces=trace, trajectories=())

    def close(self) -> None:
        pass


def served(spec: Spec, files: tuple[Path, ...], contents: dict[str, bytes]) -> tuple[str, Any]:
    assert (files, contents) == ((), {})
    if spec.task == "broken":
        raise RuntimeError("no such\n  machine")
    if spec.task == "unknown":
        raise UnservedError("not here")
    return spec.run, SimpleNamespace(size=P)


class Learner:
    """One run as a learner shows it; says only what the test says."""

    def __init__(
        self, session: Session, run: str, spec: Spec = BEGINNING, presence: Session | None = None
    ) -> None:
        """As long as the session `presence` is open, workers see that the learner is there."""
        self.session, self.run, self.asked = session, run, Counter[str]()
        self.spec = codec.encode(replace(spec, run=run))
        self.header = RoundHeader(
            run=run,
            incarnation="first",
            round=2,
            generation=0,
            spec=hashlib.sha256(self.spec).hexdigest(),
            traces="all",
            mu=np.ones(P),
        )
        session.subscribe(f"result of {run}", keys.result(FARM, run, "**"))
        session.answer(keys.spec(FARM, run), lambda: self._say("spec", self.spec))
        session.answer(
            keys.generation(FARM, run), lambda: self._say("generation", codec.encode(self.header))
        )
        (presence or session).token(keys.learner_token(FARM, run))

    def _say(self, what: str, payload: bytes) -> bytes:
        self.asked[what] += 1
        return payload

    def announce(self) -> None:
        self.session.publish(keys.generation(FARM, self.run), codec.encode(self.header))

    def send(self, worker: str, *indices: int, **changed: object) -> None:
        """Jobs of one rollout each, whose eps are their index."""
        header = self.header
        jobs = Jobs.exploring(
            np.array([np.full(len(header.mu), float(i)) for i in indices]), (1,), None
        )
        jobs.table[:, 0] = indices
        values = {"run": self.run, "incarnation": header.incarnation, "round": header.round}
        chunk = Chunk.carrying(jobs, **(values | changed))  # type: ignore[arg-type]
        self.session.publish(keys.inbox(FARM, worker), codec.encode(chunk))


class Stage:
    """A farm's network with a place for learners, and one worker at a time on a thread."""

    def __init__(self, session: Session, endpoint: str) -> None:
        self.session, self.endpoint = session, endpoint
        self._stop, self._open = threading.Event(), ExitStack()
        self._hired: list[Session] = []
        session.subscribe("want", keys.want(FARM, "**"))
        session.watch("worker", keys.worker_token(FARM, "**"))

    def hire(self, **changed: Any) -> Worker:
        config = WorkerConfig(connect=(self.endpoint,), farm=FARM, name="w", **changed)
        session = self._open.enter_context(
            connect((self.endpoint,), WAIT, lambda: False, config.bundle)
        )
        worker = Worker(config, session)
        self._open.callback(worker.close)
        self._hired.append(session)
        worker.join()
        thread = threading.Thread(target=self._work, args=(worker,))
        thread.start()
        self._open.callback(thread.join)
        # Before, it could not be reached
        until(lambda: self.session.present(keys.worker_token(FARM, worker.id), 1.0))
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
                return keys.worker_in(event.key, keys.worker_token(FARM, "")), event.alive
            return event.topic, codec.decode(
                event.payload, kind or (WorkRequest if event.topic == "want" else Results)
            )

    @property
    def queued(self) -> int:
        """Events that the newest worker has not taken yet."""
        return len(self._hired[-1].events)

    def asked(self, matches: Callable[[WorkRequest], object]) -> WorkRequest:
        """The next of a worker's requests that matches."""
        while True:
            _, want = self.next("want")
            assert isinstance(want, WorkRequest)
            if matches(want):
                return want

    def results(self, *runs: str) -> Results:
        _, message = self.next(*(f"result of {run}" for run in runs or ("r",)))
        assert isinstance(message, Results)
        return message

    def failure(self) -> Failure:
        _, message = self.next("result of r", kind=Failure)
        assert isinstance(message, Failure)
        return message

    def let_go(self) -> None:
        """Ask the worker to leave, and wake it."""
        self._stop.set()
        for session in self._hired:
            session.events.put(Event("refused", "", b""))

    def close(self) -> None:
        self.let_go()
        Runner.go.set()
        self._open.close()


def until(event: Callable[[], object]) -> None:
    end = time.monotonic() + WAIT
    while not event():
        assert time.monotonic() < end
        threading.Event().wait(0.005)


def indices(results: Results) -> list[int]:
    return results.jobs.tolist()


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
