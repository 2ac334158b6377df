"""A pool, and workers that follow the test's instructions; no physics."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from made import spec

from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import WorkRequest
from farm.net.session import Session
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader, rows_with_trace
from learner.pool.admission import Admission
from learner.pool.audit import Check, Finding
from learner.pool.connection import Connection
from learner.pool.mail import Mail
from learner.pool.placement import Placement
from learner.pool.pool import CHECKED, Pool
from learner.pool.round import RoundResults, Shapes
from learner.pool.scheduler import SchedulerConfig

FARM, RUN, TRACE = "try", "r", (3, 4)
SPEC = spec(run=RUN)
SHAPES = {"bodies": (2, 7), "actions": (1,), "terms": (2,), "channels/angle": (1,)}
PATIENT = SchedulerConfig(straggler_seconds=60.0, audit=0.0)
WAIT = 20.0


def request(
    worker: str, credits: int = 1, *, idle: bool = False, fingerprint: str = "c"
) -> WorkRequest:
    runs = (RUN,) if idle else ()
    return WorkRequest(
        worker=worker,
        credits=credits,
        idle=runs,
        version="0",
        fingerprint=fingerprint,
        host="h",
        cores=2,
    )


HEADER = RoundHeader(
    run=RUN, incarnation="i", round=1, generation=0, spec="", traces="none", mu=np.zeros(2)
)


def secret(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


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
        session.subscribe("refused", keys.refused(FARM, name))
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

    def refusal(self) -> bytes:
        return self.next("refused")

    def want(self, credits: int, *, idle: bool = False) -> None:
        self.say(keys.want(FARM, self.name), request(self.name, credits, idle=idle))

    def say(self, key: str, message: object) -> None:
        self.session.publish(key, message if isinstance(message, bytes) else codec.encode(message))

    def results(self, chunk: Chunk, *indices: int, value: float | None = None) -> Results:
        """Of all jobs of a chunk, or of these."""
        numbers = sorted(indices or chunk.indices.tolist())
        returns = np.repeat(np.array(numbers, dtype=float) if value is None else value, 2)
        traces = np.zeros(
            (len(rows_with_trace("extremes", returns, np.ones(len(returns), bool))), *TRACE), "<f4"
        )
        return Results(
            **head(chunk),
            worker=self.name,
            jobs=np.array(numbers),
            returns=returns,
            flags=np.zeros((len(returns), 4), bool),
            steps=np.ones(len(returns), "<i8"),
            traces=traces,
            trajectories=(),
        )

    def failure(self, chunk: Chunk, index: int | None, error: str) -> Failure:
        return Failure(**head(chunk), worker=self.name, index=index, error=error)

    def answer(self, message: object) -> None:
        self.say(keys.result(FARM, RUN, self.name), message)

    def work(self, count: int) -> list[int]:
        """Answer chunks until this number of jobs is done."""
        done: list[int] = []
        while len(done) < count:
            chunk = self.chunk()
            self.answer(self.results(chunk))
            done += chunk.indices.tolist()
        return done


def head(chunk: Chunk) -> dict[str, object]:
    return {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round}


def honest(job: int) -> bytes:
    """The right answer to one of `jobs`, as RoundResults gives it."""
    flags = np.zeros((2, 4), bool)
    return np.full(2, float(job)).tobytes() + flags.tobytes() + np.ones(2, "<i8").tobytes()


class Able:
    """A checker without a process, which can do every job."""

    room = 64
    trouble = ""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._found: list[tuple[Check, Finding]] = []

    def give(self, checks: Sequence[Check]) -> None:
        for check in checks:
            right = check.answer == honest(int(check.job.indices[0]))
            self._found.append((check, "right" if right else "wrong"))
        self._session.events.put(Event(CHECKED, "", b""))

    def findings(self) -> list[tuple[Check, Finding]]:
        found = self._found
        self._found = []
        return found


class Learner:
    """A pool, its rounds collected on another thread."""

    def __init__(self, session: Session) -> None:
        self.session, self.stop = session, threading.Event()
        self._thread = ThreadPoolExecutor(1)

    def show(
        self,
        scheduler: SchedulerConfig = PATIENT,
        stopped: Callable[[], bool] | None = None,
        join: str | None = "farm worker --connect here",
        fingerprint: str = "c",
        *,
        any_rounding: bool = False,
        checked: bool = False,
    ) -> Pool:
        place = Placement(farm=FARM, scheduler=scheduler)
        self.pool = Pool(
            Connection(self.session, place, stopped or self.stop.is_set),
            Mail(self.session, FARM, SPEC),
            Shapes(trace=TRACE, frame=SHAPES),
            Admission(fingerprint, any_rounding=any_rounding),
            generations=9,
            join=join,
            checker=Able(self.session) if checked else None,  # type: ignore[arg-type]
        )
        return self.pool

    def collect(self, todo: Jobs, *, checked: bool = False) -> "Future[RoundResults]":
        self.pool.begin(0, np.zeros(2), todo, "extremes")
        return self._thread.submit(self.pool.collect, checked=checked)

    def close(self) -> None:
        self.stop.set()
        self._thread.shutdown()


Hire = Callable[..., Any]


def done(results: RoundResults) -> list[float]:
    """The returns of each job's first rollout."""
    return results.returns[::2].tolist()
