"""The learner's side of the network: sends a round's jobs to workers and collects the results.

Only the caller's thread uses the scheduler and publishes; subscriptions fill a queue that it reads.
"""

import hashlib
import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import MessageError, RunError
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.notices import Notices
from farm.net.session import FLOOD, Session
from farm.net.stats import GenerationStats
from farm.net.telemetry import RunStatus, WorkerStatus
from farm.net.work import NOT_NORMALISED, Chunk, Failure, Jobs, Results, RoundHeader
from farm.sim.complaints import KINDS, explained
from learner.scheduler.judging import Judge, Judging
from learner.scheduler.ledger import Ledger
from learner.scheduler.membership import Admission, Attendance, Members
from learner.scheduler.round import RoundResults, Shapes
from learner.scheduler.scheduler import SchedulerConfig
from learner.scheduler.silence import Silences
from learner.scheduler.status import StatusAnswer

log = logging.getLogger(__name__)

_WAIT: Final = 0.2  # [s] at most between two checks whether to stop
_ASK: Final = 0.5  # [s] timeout of a query for one token
# Tokens per query round: a query for all 30 000 tokens of a large farm takes Zenoh 9 s
_LOOKS: Final = 5
# Requests or results of one worker, which has a few chunks at a time, and asks once per second
_UNREAD: Final = 100
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
        shapes: Shapes,
        scheduler: SchedulerConfig | None = None,
        judge: Judge | None = None,
        end: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Show the run on the network: subscriptions first, the liveliness token last.

        Args:
          session: an open session; this dispatcher reads its events.
          farm: name of the farm.
          spec: what the run simulates.
          generations: number of generations of the run, for `farm status`.
          how_to_join: the command that starts workers, shown when there are none; None if they are
              local.
          stopped: called regularly; if it returns true, `collect` raises Stopped.
          admission: decides which workers may take part.
          shapes: of the results.
          scheduler: how jobs are cut into chunks, and when they are sent again.
          judge: decides between hosts whose answers differ; without one, other hosts do.
          end: ends the process of a worker of this machine, to be replaced; false if it is none.
        """
        self.run, self.admission = spec.run, admission
        self.notices = Notices(log)  # what was ignored, and why
        self.stopped = stopped
        """Whether the user asked the run to stop; to be called regularly."""
        self._session, self._farm, self._shapes = session, farm, shapes
        self._how_to_join, self._generations = how_to_join, generations
        config = scheduler or SchedulerConfig()
        self._attendance, self._members = Attendance(config.instances), Members(admission)
        # The secret decides what is checked, and no number of the run
        secret = np.random.default_rng(secrets.randbits(128))
        self._ledger = Ledger(config, self._members.canary if admission.mixed else None, secret)
        simulated = codec.encode(spec)
        self._header = RoundHeader(
            run=self.run,
            incarnation=secrets.token_hex(8),
            round=0,
            generation=0,
            spec=hashlib.sha256(simulated).hexdigest(),
            traces="none",
            mu=np.empty(0),
        )
        self._status, self._alone = StatusAnswer(), time.monotonic()
        self.warned: Counter[str] = Counter()
        """In how many rollouts MuJoCo warned of something, by kind; also in those that were
        repeated.
        """
        self._told = False  # why a rollout failed by an error of its code; once in a run
        self._progress: GenerationStats | None = None
        self._silences, self._end = Silences(), end
        self._judging = Judging(judge, None if admission.mixed else admission.canary)
        # Each worker asks once per second
        session.rates.most = max(session.rates.most, 4 * config.instances)
        session.subscribe("want", keys.want(farm, "**"), most=_UNREAD)
        session.subscribe("result", keys.result(farm, self.run, "**"), most=_UNREAD)
        session.watch("worker", keys.worker_token(farm, "**"))
        session.answer(keys.spec(farm, self.run), lambda: simulated)
        session.answer(keys.generation(farm, self.run), lambda: codec.encode(self._header))
        session.answer(keys.status(farm, self.run), lambda: self._status.payload)
        self._refresh_status()
        session.token(keys.learner_token(farm, self.run))

    @property
    def incarnation(self) -> str:
        """Random identifier of this start of the run's learner."""
        return self._header.incarnation

    @property
    def workers(self) -> tuple[str, ...]:
        """Workers that take part, sorted."""
        return tuple(sorted(self._ledger.scheduler.workers))

    def census(self) -> tuple[WorkerStatus, ...]:
        """Workers that take part, with their recent rates."""
        return self._members.status(time.monotonic())

    @property
    def reissued(self) -> int:
        """Number of jobs sent again since the start."""
        return self._ledger.scheduler.reissued

    @property
    def checks(self) -> dict[str, int]:
        """Number of spot checks since the start that each host has passed."""
        return self._ledger.audit.passed_checks

    @property
    def hosts(self) -> list[str]:
        """Hosts whose answers this round has."""
        return self._ledger.audit.hosts

    def begin(
        self,
        generation: int,
        mu: FloatArray,
        jobs: Jobs,
        traces: str = "none",
        normaliser: FloatArray = NOT_NORMALISED,
        *,
        terms: bool = False,
    ) -> None:
        """Announce a round and hand out its first jobs.

        Args:
          generation: number of updates done.
          mu: mean of the search distribution, (P,).
          jobs: all jobs of the round, by index.
          traces: which traces of the exploring rollouts workers must send, one of TRACES.
          normaliser: of the observations, as in RoundHeader, (2, 2, d).
          terms: whether workers must send each reward term's part of the returns.
        """
        # Idle reports that were sent before this round
        for event in self._session.events.waiting(0.0):
            self._take(event)
        self._header = replace(
            self._header,
            round=self._header.round + 1,
            generation=generation,
            traces=traces,
            mu=mu,
            normaliser=normaliser,
            terms=terms,
        )
        header = codec.encode(self._header)
        observed = normaliser.shape[-1] > 0
        self._ledger.begin(RoundResults(jobs, traces, self._shapes, observed=observed, terms=terms))
        self._judging.begin(self._header, self._ledger.round)
        # Back to back with the jobs
        self._session.publish(keys.generation(self._farm, self.run), header)
        self._send(self._ledger.due(time.monotonic()))

    def collect(self) -> RoundResults:
        """Wait for the results of the round that has begun.

        Raises:
          RunError: a job failed on several workers.
          Stopped: the user asked the run to stop.
        """
        for _ in self.progress():
            pass
        return self._ledger.round

    def progress(self) -> Iterator[RoundResults]:
        """Yield the current round after each batch of events, until all its jobs are done and
        checked.
        """
        while not self._ledger.over:
            for event in self._events():
                self._take(event)
            self._send(self._ledger.due(time.monotonic()))
            if self._ledger.scheduler.complete and (hosts := self._ledger.audit.disputed):
                self.notices.once(
                    f"{hosts} returned different numbers for the same job, and there is no third"
                    " host to decide which is right: the run waits for a worker on one more"
                    " machine; or resume it on a machine with the numbers"
                    f" {self.admission.canary[:8]}, which then decides itself"
                )
            self._end_if_nobody_can_come()
            self._look_for_silence()
            self._refresh_status()
            if self.stopped():
                raise Stopped
            yield self._ledger.round
        self._judging.ended(self._ledger.audit)

    def check_the_rest(self) -> bool:
        """Check the hosts whose last answers no second host could check; return whether any was
        wrong.

        Its jobs of this round are to be collected again.
        """
        wrong = self._judging.settle(self._ledger.audit, self.notices.once)
        for host, generation in wrong.items():
            self._expel(host, f"host {host} was wrong in a job of generation {generation}")
        return bool(wrong)

    def report(self, progress: GenerationStats) -> None:
        """Store the last generation's statistics for `farm status`."""
        self._progress = progress

    def _events(self) -> list[Event]:
        """Events that arrived; waits for one until the next deadline at most."""
        due = self._ledger.scheduler.next_deadline(time.monotonic())
        return self._session.events.waiting(_WAIT if due is None else max(0.001, min(due, _WAIT)))

    def _take(self, event: Event) -> None:
        ignored = self.notices.ignored.total()
        try:
            if event.topic == "want":
                self._asked(event)
            elif event.topic == "worker":
                self._liveliness(event)
            elif event.topic == FLOOD:
                # Routers cut the machine off
                self._session.publish(keys.cut(self._farm, event.key), b"", block=False)
            else:
                self._result(event)
        except MessageError as error:
            self.notices.ignore(error.kind, f"on {event.key}: {error}")
        if event.topic == "want" or self.notices.ignored.total() > ignored:
            self._session.burden(event)

    def _asked(self, event: Event) -> None:
        sender = keys.worker_in(event.key, keys.want(self._farm, ""))
        try:
            want = codec.decode(event.payload, WorkRequest)
        except MessageError as error:
            # A worker of another release cannot read the refusal either, but it logs that. A sender
            # that already takes part has our release, so this message is not its own.
            if error.kind == "version" and sender not in self._ledger.scheduler.workers:
                self._refuse(sender, str(error))
            raise
        if want.worker != sender:
            self.notices.ignore("foreign", f"of {want.worker} from {sender}")
        elif self._attendance.asked(want, time.monotonic()):
            self._admit(want)

    def _admit(self, want: WorkRequest) -> None:
        reason = self._members.refusal(want)
        if reason is not None:
            self._refuse(want.worker, reason)
            return
        if want.worker in self._members.declined:
            return
        if want.worker not in self._ledger.scheduler.workers:
            log.info("worker %s joined (release %s)", want.worker, want.version)
        now, idle = time.monotonic(), self.run in want.idle
        self._ledger.scheduler.want(want.worker, want.credits, now, idle=idle)
        self._heard(want.worker)
        if idle:
            self._ledger.audit.lost(want.worker)
        self._members.asked(want, now)

    def _refuse(self, worker: str, reason: str) -> None:
        """Log the refusal here, and send it to the worker each time it asks, in case a message was
        lost.
        """
        self.notices.once(f"worker {worker} is refused: {reason}")
        self._ledger.lost(worker)
        self._members.refuse(worker, reason)
        message = codec.encode(Refusal(run=self.run, reason=reason))
        self._session.publish(keys.refused(self._farm, worker), message, block=False)

    def _liveliness(self, event: Event) -> None:
        worker = keys.worker_in(event.key, keys.worker_token(self._farm, ""))
        if event.alive:
            self._came(worker)
            return
        self._attendance.left(worker)
        self._members.left(worker)
        self._silences.left(worker)
        if worker in self._ledger.scheduler.workers:
            again = self._ledger.lost(worker)
            log.info(
                "worker %s left%s", worker, f"; {again} of its jobs are sent again" if again else ""
            )

    def _came(self, worker: str) -> None:
        early = self._attendance.came(worker)
        if early is not None:
            self._admit(early)

    def _look_who_is_there(self) -> None:
        """Query the tokens of workers that ask for work without one: Zenoh sometimes misses a new
        token.
        """
        now, attendance = time.monotonic(), self._attendance
        for worker in attendance.early(_LOOKS):
            if self._session.present(keys.worker_token(self._farm, worker), _ASK):
                try:
                    self._came(worker)
                except MessageError as error:
                    self.notices.ignore(error.kind, f"of {worker}: {error}")
        for worker in attendance.absent(now):
            self.notices.ignore("absent", f"of {worker}, whose liveliness token is missing")

    def _result(self, event: Event) -> None:
        sender = keys.worker_in(event.key, keys.result(self._farm, self.run, ""))
        if sender in self._members.refused:
            raise MessageError("a result of a worker that is not admitted", "refused")
        # Before it is decoded: a flood must cost little
        if kind := self._ledger.scheduler.unread(sender):
            raise MessageError("a result of a worker without jobs of this round", kind)
        try:
            message: Results | Failure = codec.decode(event.payload, Results)
        except MessageError as first:
            if first.kind != "bad":
                raise
            try:
                message = codec.decode(event.payload, Failure)
            except MessageError:
                raise first from None
        if message.worker != sender or message.run != self.run:
            self.notices.ignore("foreign", f"of {message.worker} on {event.key}")
        elif (message.incarnation, message.round) != (self.incarnation, self._header.round):
            self.notices.ignored["stale"] += 1
            self._heard(sender)
        elif isinstance(message, Failure):
            self._failed(message)
            self._heard(sender)
        else:
            self._count(message)
            self._heard(sender)

    def _heard(self, worker: str) -> None:
        self._silences.heard(worker, time.monotonic(), waiting=self._ledger.scheduler.holds(worker))

    def _look_for_silence(self) -> None:
        """Say which workers have not answered for long; end and replace those of this machine.

        Raises:
          RunError: that happens again and again.
        """
        for worker, silence, over in self._silences.long(
            time.monotonic(), self._ledger.scheduler.patience
        ):
            seconds = time.monotonic() - silence.since
            what = f"job {silence.job} of generation {silence.generation}"
            if not over:
                log.warning(
                    "worker %s has not answered for %.0f s, at %s: does its task hang?",
                    worker,
                    seconds,
                    what,
                )
            elif self._end(worker):
                log.warning(
                    "worker %s has not answered for %.0f s, at %s: it is replaced",
                    worker,
                    seconds,
                    what,
                )
                if self._silences.end(self._header.round):
                    raise RunError(
                        f"{self._silences.ended} workers had to be replaced because they did not"
                        f" answer, the last after {seconds:.0f} s at {what}: the task hangs"
                    )

    def _count(self, message: Results) -> None:
        now = time.monotonic()
        verdicts, wrong = self._ledger.put(message, now, self._judging.right)
        if not verdicts:
            raise MessageError("results that do not fit their jobs", "bad")
        for host, job in wrong.items():
            others = "this machine" if job in self._judging.decided else "two other hosts"
            where = f"than {others} for job {job} of round {self._header.round}"
            self._expel(host, f"host {host} gave different numbers {where}")
        self.notices.ignored.update(
            verdict for verdict in verdicts if verdict not in ("new", "tried")
        )
        # No notice about a worker that was lost meanwhile
        if "unasked" in verdicts and message.worker in self.workers:
            self.notices.once(
                f"worker {message.worker} sent results of jobs that it was not given; they are"
                " ignored"
            )
        self._members.did(message.worker, len(message.returns), now)
        for kind, count in message.warned.items():
            if kind in KINDS and kind not in self.warned:
                log.warning("%s", explained(kind))
            self.warned[kind] += count
        if message.error and not self._told:
            self._told = True
            text = f"a rollout failed, and counts as such: {message.error} (--strict ends the run)"
            self.notices.once(text, message.traceback)

    def _expel(self, host: str, reason: str) -> None:
        """A host's numbers are wrong: exclude it, and repeat its jobs of this round."""
        for worker in self._members.expel(host, reason):
            self._refuse(worker, reason)
        log.error(
            "%s; it is expelled, and %d of its jobs are repeated", reason, self._ledger.expel(host)
        )

    def _failed(self, failure: Failure) -> None:
        if failure.index is None:
            self._decline(failure.worker, failure.error, failure.traceback)
            return
        if not 0 <= failure.index < len(self._ledger.round):
            raise MessageError("an error at no job of this round", "bad")
        self.notices.once(
            f"worker {failure.worker} failed at a job: {failure.error}", failure.traceback
        )
        if self._ledger.scheduler.error(failure.worker, failure.index, time.monotonic()):
            judgement = (
                None
                if self.admission.mixed
                else self._judging.right(failure.index, self.admission.canary)
            )
            # With devices, this machine's simulation says nothing about theirs
            if judgement is not None:
                for worker in self._ledger.scheduler.failed_at(failure.index):
                    self._decline(
                        worker, f"it failed at job {failure.index}, which this machine can do"
                    )
                return
            seed = self._ledger.round.jobs.take([failure.index]).seeds()[0]
            raise RunError(
                f"job {failure.index} of generation {self._header.generation} (seed {seed}) failed"
                f" wherever it was tried, last with {failure.error}"
            )

    def _decline(self, worker: str, reason: str, traceback: tuple[str, ...] = ()) -> None:
        """A connected worker cannot build the task, or may not serve it, or fails; a different
        one may be better.
        """
        if worker in self._ledger.scheduler.workers:
            self.notices.once(f"worker {worker} does not serve this run: {reason}", traceback)
            self._ledger.scheduler.refused(worker)
            self._ledger.lost(worker)
            self._members.decline(worker, reason)

    def _send(self, jobs: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Send jobs, by worker, to their inboxes."""
        # Without block: a frozen host must not delay the others; deadlines cover lost messages.
        head = {"run": self.run, "incarnation": self.incarnation, "round": self._header.round}
        for worker, indices in jobs:
            self._silences.given(worker, indices[0], self._header.generation, time.monotonic())
            for part in self._ledger.round.messages(indices):
                chunk = Chunk.carrying(self._ledger.round.jobs.take(part), **head)
                self._session.publish(
                    keys.inbox(self._farm, worker), codec.encode(chunk), block=False
                )

    def _refresh_status(self) -> None:
        if self._status.due:
            self._look_who_is_there()
            self._status.make(self._run_status)

    def _run_status(self) -> RunStatus:
        last = self._progress
        ignored = self.notices.ignored + Counter(flood=self._session.events.dropped)
        return RunStatus(
            run=self.run,
            generation=self._header.generation,
            generations=self._generations,
            return_mean=last.return_mean if last else None,
            mean_policy_return=last.mean_policy_return if last else None,
            open=self._ledger.scheduler.remaining,
            reissued=self.reissued,
            refused=len(self._members.reasons),
            ignored=dict(ignored),
            workers=self.census(),
            numbers=self.admission.canary,
        )

    def _end_if_nobody_can_come(self) -> None:
        """Say how workers join if there are none.

        Raises:
          RunError: the run's own workers do not take part; no others can join, as its port is not
              announced.
        """
        now = time.monotonic()
        if self._ledger.scheduler.workers:
            self._alone = now
        elif now - self._alone > _PATIENCE and self._how_to_join is None:
            if self._members.reasons:
                raise RunError(f"no worker takes part: {self._members.reasons[0]}")
        elif now - self._alone > _PATIENCE:
            log.warning("no workers; start some with: %s", self._how_to_join)
            self._alone = float("inf")
