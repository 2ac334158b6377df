"""The learner's side of the network: sends a round's jobs to workers and collects the results.

Only the caller's thread uses the scheduler and publishes; subscriptions fill a queue that it reads.
"""

import hashlib
import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import MessageError, RunError, brief
from farm.net import codec, keys
from farm.net.codec import M
from farm.net.events import Event
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.session import Session
from farm.net.stats import GenerationStats
from farm.net.telemetry import RunStatus, WorkerStatus
from farm.net.work import NOT_NORMALISED, Chunk, Failure, Jobs, Results, RoundHeader
from learner.scheduler.audit import Audit, host
from learner.scheduler.membership import Admission, Attendance, Census
from learner.scheduler.round import RoundResults
from learner.scheduler.scheduler import Scheduler, SchedulerConfig, Verdict

log = logging.getLogger(__name__)

_WAIT: Final = 0.2  # [s] at most between two checks whether to stop
_STATUS: Final = 0.5  # [s] at least between two updates of the status
_STATUS_PART: Final = 0.02  # largest share of the learner's time for these: with a thousand workers one takes long
_ASK: Final = 0.5  # [s] timeout of a query for one token
_LOOKS: Final = 5  # tokens per query round: a query for all 30 000 tokens of a large farm takes Zenoh 9 s
_CHUNK: Final = 32 << 20  # [bytes] of eps in one message, unless one job alone has more
_REFUSED: Final = 10_000  # number of refused workers that are remembered
_PATIENCE: Final = 3.0  # [s] without workers before the user is warned


class Stopped(Exception):  # noqa: N818  not an error
    """The user asked the run to stop."""


class Dispatcher:
    """Runs rounds of jobs, one after another, on the workers that are connected."""

    def __init__(
        self,
        session: Session,
        farm: str,
        spec: Spec,
        generations: int,
        how_to_join: str | None,
        stopped: Callable[[], bool],
        admission: Admission,
        sizes: tuple[tuple[int, int], Mapping[str, tuple[int, ...]]],
        scheduler: SchedulerConfig | None = None,
    ) -> None:
        """Show the run on the network: subscriptions first, the liveliness token last.

        Args:
          session: an open session; this dispatcher reads its events.
          farm: name of the farm.
          spec: what the run simulates.
          generations: number of generations of the run, for `farm status`.
          how_to_join: the command that starts workers, shown when there are none; None if they are local.
          stopped: called regularly; if it returns true, `collect` raises Stopped.
          admission: decides which workers may take part.
          sizes: shape of a trace, and of a frame of each of a trajectory's arrays.
          scheduler: how jobs are cut into chunks, and when they are sent again.
        """
        self.run = spec.run
        self.ignored: Counter[str] = Counter()
        """Number of ignored messages, by kind: stale, doubled, unasked, foreign, absent, refused, bad, large,
        version, flood."""
        self.admission = admission
        self._session, self._farm, self._stopped = session, farm, stopped
        scheduler = scheduler or SchedulerConfig()
        self._scheduler = Scheduler(scheduler)
        self._expelled: dict[str, str] = {}  # hosts and reasons
        self._how_to_join = how_to_join
        self._trace, self._shapes = sizes
        self._incarnation = secrets.token_hex(8)
        self._spec = codec.encode(spec)
        self._header = RoundHeader(
            run=self.run, incarnation=self._incarnation, round=0, generation=0,
            spec=hashlib.sha256(self._spec).hexdigest(), traces="none", mu=_NOTHING,
        )  # fmt: skip
        self._round: RoundResults | None = None
        self._told: set[str] = set()
        self._attendance = Attendance()
        self._refused: dict[str, str] = {}
        self._declined: set[str] = set()
        self._census = Census()
        self._audit = Audit(scheduler.audit, self._census.canary if admission.mixed else None)
        self._progress: GenerationStats | None = None
        self._generations, self._status, self._status_due = generations, b"", 0.0
        self._alone = time.monotonic()
        session.subscribe("want", keys.want(farm, "**"))
        session.subscribe("result", keys.result(farm, self.run, "**"))
        session.watch("worker", keys.worker_token(farm, "**"))
        session.answer(keys.spec(farm, self.run), lambda: self._spec)
        session.answer(keys.generation(farm, self.run), lambda: codec.encode(self._header))
        session.answer(keys.status(farm, self.run), lambda: self._status)
        self._tell_status()
        session.token(keys.learner_token(farm, self.run))

    @property
    def incarnation(self) -> str:
        """Random identifier of this start of the run's learner."""
        return self._incarnation

    @property
    def workers(self) -> tuple[str, ...]:
        """Workers that take part, sorted."""
        return tuple(sorted(self._scheduler.workers))

    def census(self) -> tuple[WorkerStatus, ...]:
        """Workers that take part, with their recent rates."""
        return self._census.status(time.monotonic())

    @property
    def reissued(self) -> int:
        """Number of jobs sent again since the start."""
        return self._scheduler.reissued

    def begin(
        self,
        generation: int,
        mu: FloatArray,
        jobs: Jobs,
        traces: str = "none",
        normaliser: FloatArray = NOT_NORMALISED,
    ) -> None:
        """Announce a round and hand out its first jobs.

        Args:
          generation: number of updates done.
          mu: mean of the search distribution, (P,).
          jobs: all jobs of the round, by index.
          traces: which traces of the exploring rollouts workers must send, one of TRACES.
          normaliser: of the observations, as in RoundHeader, (2, 2, d).
        """
        if self._round is not None:  # take idle reports that were sent before this round
            for event in self._session.events.waiting(0.0):
                self._take(event)
        self._header = RoundHeader(
            run=self.run, incarnation=self._incarnation, round=self._header.round + 1,
            generation=generation, spec=self._header.spec, traces=traces, mu=mu, normaliser=normaliser,
        )  # fmt: skip
        header = codec.encode(self._header)
        self._round = RoundResults(jobs, traces, self._trace, self._shapes, normaliser.shape[-1])
        self._scheduler.begin(len(jobs))
        self._audit.begin(len(jobs))
        self._session.publish(keys.generation(self._farm, self.run), header)  # back to back with the jobs
        self._send(self._scheduler.assign(time.monotonic()))

    def collect(self) -> RoundResults:
        """Wait for the results of the round that has begun.

        Raises:
          RunError: a job failed on several workers.
          Stopped: the user asked the run to stop.
        """
        assert self._round is not None
        for _ in self.progress():
            pass
        return self._round

    def progress(self) -> Iterator[RoundResults]:
        """Yield the current round after each batch of events, until all its jobs are done and checked."""
        assert self._round is not None
        while not self._over():
            for event in self._events():
                self._take(event)
            if not self._scheduler.complete:
                if self._audit.early and self._scheduler.half_done:
                    self._audit.choose(self._round, self._scheduler.willing, end=False)
                self._check()
                self._send(self._scheduler.assign(time.monotonic()))
            self._tell_when_alone()
            self._tell_status()
            if self._stopped():
                raise Stopped
            yield self._round

    def _over(self) -> bool:
        """Whether all jobs are done and checked; sends the checks that are still open."""
        assert self._round is not None
        if not self._scheduler.complete:
            return False
        if self._audit.passed(self._round, self._scheduler.willing):
            return True
        self._check()
        if self._audit.disputed:
            self._warn(
                f"{self._audit.disputed} returned different numbers for the same job, and there is no third host to "
                "decide which is right: the run waits for a worker on one more machine"
            )
        return False

    def _check(self) -> None:
        """Send the spot checks that are open."""
        now, patience = time.monotonic(), self._scheduler.patience
        if not self._audit.due(now, patience):
            return
        asked = self._audit.assign(self._scheduler.willing, now, patience)
        for worker, indices in asked.items():
            self._scheduler.lend(worker, indices)
        self._send(asked.items())

    def _events(self) -> list[Event]:
        """Events that arrived; waits for one until the next deadline at most."""
        due = self._scheduler.next_deadline(time.monotonic())
        return self._session.events.waiting(_WAIT if due is None else max(0.001, min(due, _WAIT)))

    def _take(self, event: Event) -> None:
        try:
            if event.topic == "want":
                self._asked(event)
            elif event.topic == "worker":
                self._liveliness(event)
            else:
                self._result(event)
        except MessageError as error:
            self._ignore(error.kind, f"on {event.key}: {error}")

    def _asked(self, event: Event) -> None:
        sender = keys.worker_in(event.key, keys.want(self._farm, ""))
        try:
            want = _decode(event, WorkRequest)
        except MessageError as error:
            # A worker of another release cannot read the refusal either, but it logs that. A sender that already
            # takes part has our release, so this message is not its own.
            if error.kind == "version" and sender not in self._scheduler.workers:
                self._refuse(sender, str(error))
            raise
        if want.worker != sender:
            self._ignore("foreign", f"of {want.worker} from {sender}")
            return
        if self._attendance.asked(want, time.monotonic()):
            self._admit(want)

    def _admit(self, want: WorkRequest) -> None:
        refusal = self._expelled.get(host(want.worker)) or self.admission.refusal(want)
        if refusal is not None:
            self._refuse(want.worker, refusal)
            return
        self._refused.pop(want.worker, None)
        if want.worker in self._declined:
            return
        if want.worker not in self._scheduler.workers:
            log.info("worker %s joined (release %s)", want.worker, want.version)
        now = time.monotonic()
        self._scheduler.want(want.worker, want.credits, now, idle=self.run in want.idle)
        if self.run in want.idle:
            self._audit.lost(want.worker)
        self._census.asked(want, now)

    def _refuse(self, worker: str, reason: str) -> None:
        """Log the refusal here, and send it to the worker each time it asks, in case a message was lost."""
        self._warn(f"worker {worker} is refused: {reason}")
        if len(self._refused) < _REFUSED:
            self._refused[worker] = reason
        message = codec.encode(Refusal(run=self.run, reason=reason))
        self._session.publish(keys.refused(self._farm, worker), message, block=False)

    def _liveliness(self, event: Event) -> None:
        worker = keys.worker_in(event.key, keys.worker_token(self._farm, ""))
        if event.alive:
            self._came(worker)
            return
        self._attendance.left(worker)
        self._refused.pop(worker, None)
        self._declined.discard(worker)
        if worker in self._scheduler.workers:
            again = self._forget(worker)
            log.info("worker %s left%s", worker, f"; {again} of its jobs are sent again" if again else "")

    def _came(self, worker: str) -> None:
        early = self._attendance.came(worker)
        if early is not None:
            self._admit(early)

    def _look_who_is_there(self, now: float) -> None:
        """Query the tokens of workers that ask for work without one: Zenoh sometimes misses a new token."""
        for worker in self._attendance.early(_LOOKS):
            if self._session.present(keys.worker_token(self._farm, worker), _ASK):
                try:
                    self._came(worker)
                except MessageError as error:
                    self._ignore(error.kind, f"of {worker}: {error}")
        for worker in self._attendance.absent(now):
            self._ignore("absent", f"of {worker}, whose liveliness token is missing")

    def _result(self, event: Event) -> None:
        sender = keys.worker_in(event.key, keys.result(self._farm, self.run, ""))
        try:
            message: Results | Failure = _decode(event, Results)
        except MessageError as first:
            if first.kind != "bad":
                raise
            try:
                message = _decode(event, Failure)
            except MessageError:
                raise first from None
        if message.worker != sender or message.run != self.run:
            self._ignore("foreign", f"of {message.worker} on {event.key}")
        elif message.worker in self._refused:
            self._ignore("refused", f"of {message.worker}, which is not admitted")
        elif (message.incarnation, message.round) != (self._incarnation, self._header.round):
            self.ignored["stale"] += 1
        elif isinstance(message, Failure):
            self._failed(message)
        else:
            self._count(message)

    def _count(self, message: Results) -> None:
        assert self._round is not None
        place = self._round.place(message)
        if place is None:
            self._ignore("bad", f"of {message.worker}: results that do not fit their jobs")
            return
        verdicts = self._scheduler.results(message.worker, message.jobs.tolist(), time.monotonic())
        new = np.array([verdict == "new" for verdict in verdicts])
        self._round.put(message, place, new)
        if new.any():
            self._audit.counted(message.worker, message.jobs[new])
            self._decide_numbers(message.worker)
        if "doubled" in verdicts:
            self._compare(message, verdicts)
        self.ignored.update(verdict for verdict in verdicts if verdict != "new")
        if "unasked" in verdicts:
            self._warn(f"worker {message.worker} sent results of jobs that it was not given; they are ignored")
        self._census.did(message.worker, len(message.returns), time.monotonic())

    def _decide_numbers(self, worker: str) -> None:
        """The first accepted result decides the kind of machine of the run; workers of a different kind are refused."""
        if not self.admission.counted(self._census.canary(worker)):
            return
        for want in self._census.requests():
            refusal = self.admission.refusal(want)
            if refusal is not None:
                self._forget(want.worker)
                self._refuse(want.worker, refusal)

    def _compare(self, message: Results, verdicts: list[Verdict]) -> None:
        """Compare results of jobs that two hosts did, for a check or after a copy: they must agree to the bit."""
        assert self._round is not None
        for at, (job, verdict) in enumerate(zip(message.jobs.tolist(), verdicts, strict=True)):
            if verdict == "doubled":
                asked = self._audit.answered(
                    message.worker, job, self._round.answer(job), self._round.given(message, job)
                )
                verdicts[at] = "new" if asked else verdict
        for name, job in self._audit.settle().items():
            self._expel(name, job)

    def _expel(self, name: str, job: int) -> None:
        """A host's numbers are wrong: exclude it, and repeat its jobs of this round."""
        assert self._round is not None
        reason = f"host {name} gave different numbers than two other hosts for job {job} of round {self._header.round}"
        self._expelled[name] = reason
        for worker in self.workers:
            if host(worker) == name:
                self._forget(worker)
                self._refuse(worker, reason)
        jobs = self._audit.expel(name)
        self._scheduler.reopen(jobs, name)
        self._round.forget(jobs)
        log.error("%s; it is expelled, and %d of its jobs are repeated", reason, len(jobs))

    def _failed(self, failure: Failure) -> None:
        if failure.index is None:
            self._does_not_serve(failure)
            return
        if self._round is None or not 0 <= failure.index < len(self._round):
            self.ignored["bad"] += 1
            return
        self._warn(f"worker {failure.worker} failed at a job: {failure.error}", failure.traceback)
        if self._scheduler.error(failure.worker, failure.index, time.monotonic()):
            seed = self._round.jobs.take([failure.index]).seeds()[0]
            raise RunError(
                f"job {failure.index} of generation {self._header.generation} (seed {seed}) failed wherever it was "
                f"tried, last with {failure.error}"
            )

    def _does_not_serve(self, failure: Failure) -> None:
        """A connected worker does not serve this run; a different one may."""
        if failure.worker in self._scheduler.workers:
            self._warn(f"worker {failure.worker} does not serve this run: {failure.error}", failure.traceback)
            self._declined.add(failure.worker)
            self._forget(failure.worker)

    def _forget(self, worker: str) -> int:
        """Remove a worker from the run; return how many of its jobs are sent again."""
        again = self._scheduler.lost(worker)
        self._census.left(worker)
        self._audit.lost(worker)
        return again

    def _send(self, assigned: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Send jobs to the inboxes of workers."""
        assert self._round is not None
        # Without block: a frozen host must not delay the others; deadlines cover lost messages.
        head = {"run": self.run, "incarnation": self._incarnation, "round": self._header.round}
        size = self._header.mu.nbytes + self._header.normaliser.nbytes  # of a job's eps, and of its results
        most = max(1, _CHUNK // max(1, size))
        for worker, indices in assigned:
            for first in range(0, len(indices), most):
                chunk = codec.encode(Chunk.carrying(self._round.jobs.take(indices[first : first + most]), **head))
                self._session.publish(keys.inbox(self._farm, worker), chunk, block=False)

    def report(self, progress: GenerationStats) -> None:
        """Store the last generation's statistics for `farm status`."""
        self._progress = progress

    def _tell_status(self) -> None:
        """Refresh the answer to status queries; Zenoh's thread answers them and must not read other fields."""
        now = time.monotonic()
        if now < self._status_due:
            return
        self._look_who_is_there(now)
        begun = time.monotonic()
        last, flood = self._progress, self._session.events.dropped
        if flood:
            self.ignored["flood"] = flood
        status = RunStatus(
            run=self.run,
            generation=self._header.generation,
            generations=self._generations,
            return_mean=last.return_mean if last else None,
            mean_policy_return=last.mean_policy_return if last else None,
            open=self._scheduler.remaining,
            reissued=self._scheduler.reissued,
            refused=len(self._refused) + len(self._declined),
            ignored=dict(self.ignored),
            workers=self.census(),
        )
        self._status = codec.encode(status)
        self._status_due = max(now + _STATUS, begun + (time.monotonic() - begun) / _STATUS_PART)

    def _tell_when_alone(self) -> None:
        now = time.monotonic()
        if self._scheduler.workers:
            self._alone = now
        elif now - self._alone > _PATIENCE and self._how_to_join is None:
            if self._refused:  # the run's own workers; no others can join, as its port is not announced
                raise RunError(f"no worker takes part: {next(iter(self._refused.values()))}")
        elif now - self._alone > _PATIENCE:
            log.warning("no workers; start some with: %s", self._how_to_join)
            self._alone = float("inf")

    def _ignore(self, kind: str, text: str) -> None:
        self.ignored[kind] += 1
        self._warn(f"ignored a message {text}")

    def _warn(self, text: str, traceback: tuple[str, ...] = ()) -> None:
        """Log a text once; a traceback, which many workers may send, only with the first of them."""
        text = brief(text)
        if text not in self._told and len(self._told) < 1000:
            self._told.add(text)
            log.warning("%s", text)
            whole = "\n".join(traceback)
            for line in traceback if whole not in self._told else ():
                log.warning("  %s", line)
            self._told.add(whole)


_NOTHING: Final = np.empty(0)


def _decode(event: Event, kind: type[M]) -> M:
    return codec.decode(event.payload, kind)
