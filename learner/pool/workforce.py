"""The workers of a pool: one record each, of whether it is connected, takes part and answers.

What a worker holds is the scheduler's: see `job_table`. Pure: times are seconds of one monotonic
clock, passed in.

A worker is connected while its liveliness token is there, and takes part once it has asked for work
and was admitted. A worker that works on a chunk says nothing meanwhile, so that only time tells
whether its task hangs. How much time is usual follows from the rollouts so far:
`Scheduler.patience` is four times the usual wait for an answer.
"""

from collections import Counter, deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, Literal, TypeAlias

from farm.errors import MessageError
from farm.net.messages import WorkRequest
from farm.net.telemetry import WorkerStatus
from learner.pool.admission import Admission, host

_TOKENS: Final = 10_000  # more workers than one learner can serve
_WAITING: Final = 1000  # workers whose request arrived before their token
_RECORDS: Final = 20_000  # workers that are remembered, refused ones included
_SOON: Final = 3.0  # [s] within which the token must follow: token and request travel separately
_WINDOW: Final = 10.0  # [s] over which a worker's rate is measured

LINE: Final = 10.0
"""Least silence after which a line says so [s]."""
END: Final = 30.0
"""Least silence after which a worker's process is ended [s]."""
_LINE, _END = 3.0, 6.0  # and so many times the scheduler's patience
# [s] before a worker's first answer: imports and compilers take their time
_FIRST_LINE, _FIRST_END = (60.0, 300.0)
_RARE: Final = 50  # rounds for each of which a task may hang once
_MOST: Final = 3  # workers that may be ended however few rounds there were

Standing: TypeAlias = Literal["new", "member", "refused", "declined"]
"""`refused`: the run does not take this worker; `declined`: it cannot serve the run."""


@dataclass
class Silence:
    """Time since a worker that has jobs has answered."""

    since: float
    """When it was given the job, or has last answered [s]."""
    job: int
    """Index of the job in the round in which the worker was given it."""
    generation: int
    said: bool = False
    """Whether a line has said so."""
    over: bool = False
    """Whether the worker's process was ended."""


@dataclass
class Worker:
    """A worker, from its first sign of life to the end of its token."""

    connected: bool = False
    """Whether the worker's liveliness token is there."""
    waiting: float | None = None
    """Time of its first request, if that waits for the token [s]."""
    request: WorkRequest | None = None
    """Last request for work."""
    standing: Standing = "new"
    reason: str = ""
    """Why it does not take part."""
    joined: float = 0.0
    seen: float = 0.0
    """Time of its last request or result [s]."""
    rollouts: int = 0
    recent: deque[tuple[float, int]] = field(default_factory=deque)
    """Times and numbers of rollouts of its last results."""
    answered: bool = False
    """Whether the worker has sent anything about its jobs."""
    silence: Silence | None = None
    """Time without an answer; None if the worker has no jobs."""


class Workforce:
    """Workers of a run, by name."""

    def __init__(self, admission: Admission, most: int = 500) -> None:
        """Start with nobody; at most this number of tokens per host name, so that one host cannot
        use up the limit for all.
        """
        self._admission = admission
        self._most = most
        self._workers: dict[str, Worker] = {}
        self._waiting: dict[str, None] = {}  # in the order in which their tokens are looked for
        self._tokens: Counter[str] = Counter()  # by host
        self.replaced = 0
        """Number of workers whose processes were ended."""

    # Who is connected: tokens, and requests that came before them.

    def arrived(self, worker: str) -> WorkRequest | None:
        """A token appeared; return the request that its worker sent before, if any.

        Raises:
          MessageError: there are too many tokens.
        """
        record = self._workers.get(worker)
        if record is None or not record.connected:
            name = host(worker)
            if self._tokens.total() >= _TOKENS or self._tokens[name] >= self._most:
                raise MessageError(
                    f"there are already {_TOKENS} workers, or {self._most} of its name", "absent"
                )
            self._tokens[name] += 1
            record = self._workers.setdefault(worker, Worker())
            record.connected = True
        if record.waiting is None:
            return None
        record.waiting = None
        del self._waiting[worker]
        return record.request

    def left(self, worker: str) -> None:
        """A worker is gone, and may come back as another."""
        record = self._workers.pop(worker, None)
        self._waiting.pop(worker, None)
        if record is not None and record.connected:
            self._tokens[host(worker)] -= 1

    def asked(self, want: WorkRequest, now: float) -> bool:
        """Return whether the worker that asks is connected.

        If not, keep its request until its token comes.

        Raises:
          MessageError: too many requests are kept already.
        """
        record = self._workers.get(want.worker)
        if record is not None and record.connected:
            return True
        if want.worker not in self._waiting and len(self._waiting) >= _WAITING:
            raise MessageError(
                f"there are already {_WAITING} requests of workers without a token", "absent"
            )
        record = self._workers.setdefault(want.worker, Worker())
        record.request = want
        if record.waiting is None:
            record.waiting = now
            self._waiting[want.worker] = None
        return False

    def without_token(self, most: int) -> list[str]:
        """Workers that asked but have no token.

        Those not returned for the longest time first.
        """
        names = list(islice(self._waiting, most))
        for name in names:
            self._waiting[name] = self._waiting.pop(name)
        return names

    def absent(self, now: float) -> list[str]:
        """Forget requests whose token did not follow in time; return the workers' names."""
        names = [
            name for name in self._waiting if now - (self._workers[name].waiting or 0.0) > _SOON
        ]
        for name in names:
            self.left(name)
        return names

    # Who takes part, and why others do not.

    def join(self, want: WorkRequest, now: float) -> None:
        """A worker that may take part asked for work."""
        record = self._workers.setdefault(want.worker, Worker())
        if record.standing != "member":
            record.standing = "member"
            record.joined = now
            record.rollouts = 0
            record.recent.clear()
        record.request = want
        record.seen = now

    def is_member(self, worker: str) -> bool:
        """Whether a worker takes part."""
        return self._standing(worker) == "member"

    def refuse(self, worker: str, reason: str) -> None:
        """Remember why a worker is not taken; it no longer takes part.

        One that cannot serve the run stays declined: its next request may be without fault.
        """
        known = worker in self._workers or len(self._workers) < _RECORDS
        if known and not self.is_declined(worker):
            self._set(worker, "refused", reason)

    def is_refused(self, worker: str) -> bool:
        """Whether the run does not take a worker."""
        return self._standing(worker) == "refused"

    def decline(self, worker: str, reason: str) -> None:
        """Remember why a worker cannot serve the run; it no longer takes part."""
        self._set(worker, "declined", reason)

    def is_declined(self, worker: str) -> bool:
        """Whether a worker cannot serve the run."""
        return self._standing(worker) == "declined"

    @property
    def reasons(self) -> list[str]:
        """Why workers do not take part, refused ones first."""
        return [
            record.reason
            for standing in ("refused", "declined")
            for record in self._workers.values()
            if record.standing == standing
        ]

    def expel(self, name: str, reason: str) -> list[str]:
        """Take no worker of a host any more; return those that take part."""
        self._admission.expelled[name] = reason
        return [worker for worker in self._members() if host(worker) == name]

    # What they do: rates and fingerprints.

    def did(self, worker: str, rollouts: int, now: float) -> None:
        """A worker sent results."""
        if not self.is_member(worker):
            return
        record = self._workers[worker]
        record.seen = now
        record.rollouts += rollouts
        record.recent.append((now, rollouts))
        while record.recent[0][0] < now - _WINDOW:
            record.recent.popleft()

    def fingerprint(self, worker: str) -> str:
        """The digest of how a worker rounds; empty if it is a device or does not take part."""
        request = self._workers[worker].request if self.is_member(worker) else None
        return "" if request is None else request.fingerprint

    def status(self, now: float) -> tuple[WorkerStatus, ...]:
        """The workers that take part, by name."""
        return tuple(_status(name, record, now) for name, record in sorted(self._members().items()))

    # Who does not answer.

    def given(self, worker: str, job: int, generation: int, now: float) -> None:
        """A worker was given a job; if it has others, it is silent since these."""
        record = self._workers.setdefault(worker, Worker())
        record.silence = record.silence or Silence(now, job, generation)

    def heard(self, worker: str, now: float, *, waiting: bool) -> None:
        """A worker has sent a message about its jobs; `waiting`: it still has some."""
        record = self._workers.get(worker)
        if record is None:
            return
        record.answered = True
        if record.silence is not None:
            record.silence.since = now
            record.silence.said = False
            if not waiting:
                record.silence = None

    def silent(self, now: float, patience: float) -> list[tuple[str, Silence, bool]]:
        """Workers whose silence has just become too long, and whether their process is to be
        ended.
        """
        silent = []
        for worker, record in self._workers.items():
            if (silence := record.silence) is None or silence.over:
                continue
            line = max(LINE, _LINE * patience, 0.0 if record.answered else _FIRST_LINE)
            end = max(END, _END * patience, 0.0 if record.answered else _FIRST_END)
            over = now - silence.since >= end
            if over or (not silence.said and now - silence.since >= line):
                silence.said = True
                silence.over = over
                silent.append((worker, silence, over))
        return silent

    def replace(self, rounds: int) -> bool:
        """Note that a worker's process was ended; return whether that is so often that the task
        is to blame.
        """
        self.replaced += 1
        return self.replaced > _MOST and self.replaced * _RARE > rounds

    def _standing(self, worker: str) -> Standing:
        record = self._workers.get(worker)
        return "new" if record is None else record.standing

    def _set(self, worker: str, standing: Standing, reason: str) -> None:
        record = self._workers.setdefault(worker, Worker())
        record.standing = standing
        record.reason = reason
        record.silence = None

    def _members(self) -> dict[str, Worker]:
        return {
            name: record for name, record in self._workers.items() if record.standing == "member"
        }


def _status(name: str, record: Worker, now: float) -> WorkerStatus:
    request = record.request
    assert request is not None
    # At least 1 s, so that a worker has a rate at once, and at most the window
    seconds = min(_WINDOW, max(1.0, now - record.joined))
    recent = sum(count for at, count in record.recent if at >= now - _WINDOW)
    return WorkerStatus(
        worker=name,
        host=request.host,
        cores=request.cores,
        version=request.version,
        fingerprint=request.fingerprint,
        rollouts=record.rollouts,
        rate=recent / seconds,
        seen=now - record.seen,
        ignored=request.ignored,
    )
