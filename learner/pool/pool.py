"""Workers of a run as one object: rounds of jobs in, results out.

    with open_pool(connection, problem, name, admission) as pool:
        pool.begin(generation, mu, jobs)
        for results in pool.progress():
            ...

Only the caller's thread uses a pool; subscriptions fill a queue that it reads.
"""

import logging
import secrets
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import MessageError, RunError
from farm.net.events import Event
from farm.net.messages import WorkRequest
from farm.net.notices import Notices
from farm.net.session import FLOOD
from farm.net.stats import GenerationStats
from farm.net.telemetry import RunStatus, WorkerStatus
from farm.net.work import NOT_NORMALISED, Failure, Jobs, Results
from farm.processes import LocalWorkers
from farm.runner_process import Begin
from farm.sim.complaints import KINDS, explained
from learner.pool.admission import Admission, host
from learner.pool.audit import Check, Finding, Source
from learner.pool.checker import Checker
from learner.pool.connection import Connection
from learner.pool.ledger import Ledger
from learner.pool.mail import Mail
from learner.pool.placement import how_to_join, local_flags
from learner.pool.round import RoundResults, Shapes
from learner.pool.served import Served
from learner.pool.workforce import Workforce

log = logging.getLogger(__name__)

_WAIT: Final = 0.2  # [s] at most between two checks whether to stop
_TEND: Final = 0.5  # [s] between two looks for workers that hang or have died
# Tokens per query round: a query for all 30 000 tokens of a large farm takes Zenoh 9 s
_LOOKS: Final = 5
_PATIENCE: Final = 3.0  # [s] without workers before the user is warned

CHECKED: Final = "checked"
"""Topic of the event that the checker has found something."""


class Stopped(Exception):  # noqa: N818  not an error
    """The user asked the run to stop."""


class Pool:
    """Runs rounds of jobs, one after another, on the workers that are connected."""

    def __init__(
        self,
        connection: Connection,
        mail: Mail,
        shapes: Shapes,
        admission: Admission,
        *,
        generations: int = 0,
        join: str | None = None,
        checker: Checker | None = None,
    ) -> None:
        """Show the pool to workers; `open_pool` also starts those of this machine.

        Args:
          connection: to the workers.
          mail: on it.
          shapes: of the results.
          admission: decides which workers may take part.
          generations: number of generations of the run, for `farm status`.
          join: the command that starts workers, shown when there are none; None if they are local.
          checker: repeats jobs of other machines; without one, nothing is checked.
        """
        self.admission = admission
        self.notices = Notices(log)  # what was ignored, and why
        self.stopped = connection.stopped
        """Whether the user asked the run to stop; to be called regularly."""
        self.local: LocalWorkers | None = None
        """The workers of this machine."""
        self.warned: Counter[str] = Counter()
        """Number of rollouts in which MuJoCo warned, by kind, including repeated ones."""
        self._mail = mail
        self._shapes = shapes
        self._join = join
        self._generations = generations
        config = connection.place.scheduler
        self._workforce = Workforce(admission, config.instances)
        # The secret decides what is checked, and no number of the run
        secret = np.random.default_rng(secrets.randbits(128))
        self._ledger = Ledger(config, self._source, secret)
        self._checker = checker
        # By round and job, what ends the run if the checker cannot do it either, and who has failed
        self._doubted: dict[tuple[int, int], tuple[RunError, list[str]]] = {}
        self._to_try: list[Check] = []
        self._told = False  # why a rollout failed by an error of its code; once in a run
        self._last: GenerationStats | None = None
        self._alone_since = time.monotonic()
        self._tended = time.monotonic()
        # Each worker asks once per second
        rates = connection.session.rates
        rates.most = max(rates.most, 4 * config.instances)
        self._refresh_status()
        mail.show()

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the local workers."""
        return self.local.pids if self.local else []

    @property
    def incarnation(self) -> str:
        """Random identifier of this start of the run's learner."""
        return self._mail.header.incarnation

    @property
    def workers(self) -> tuple[str, ...]:
        """Workers that take part, sorted."""
        return tuple(sorted(self._ledger.scheduler.workers))

    def census(self) -> tuple[WorkerStatus, ...]:
        """Workers that take part, with their recent rates."""
        return self._workforce.status(time.monotonic())

    @property
    def reissued(self) -> int:
        """Number of jobs sent again since the start."""
        return self._ledger.scheduler.reissued

    @property
    def checks(self) -> dict[str, int]:
        """Number of checks since the start that each host has passed."""
        return self._ledger.audit.passed

    @property
    def hosts(self) -> list[str]:
        """Hosts whose answers this round has, other than this machine's workers."""
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
        for event in self._mail.events(0.0):
            self._take(event)
        observed = normaliser.shape[-1] > 0
        results = RoundResults(jobs, traces, self._shapes, observed=observed, terms=terms)
        # Back to back with the jobs
        self._mail.announce(generation, mu, traces, normaliser, terms=terms)
        self._ledger.begin(self._mail.header, results)
        self._send(self._ledger.due(time.monotonic()))

    def collect(self, *, checked: bool = False) -> RoundResults:
        """Wait for the results of the round that has begun; `checked` as in `progress`.

        Raises:
          RunError: a job failed on several workers.
          Stopped: the user asked the run to stop.
        """
        for _ in self.progress(checked=checked):
            pass
        return self._ledger.round

    def progress(self, *, checked: bool = False) -> Iterator[RoundResults]:
        """Yield the current round after each batch of events, until all its jobs are done.

        With `checked`, until all checks are made as well, also of earlier rounds: nobody checks
        these results any more.
        """
        while not self._ledger.over or (checked and not self._settled):
            self._give_checks()
            for event in self._events():
                self._take(event)
            self._take_findings()
            self._send(self._ledger.due(time.monotonic()))
            yield self._ledger.round  # first, so that the caller saves which hosts are expelled
            self._end_if_nobody_can_come()
            if time.monotonic() > self._tended + _TEND:
                self._tended = time.monotonic()
                self._look_for_silence()
                self._tend()
            self._refresh_status()
            if self.stopped():
                raise Stopped
        self._give_checks()

    def report(self, progress: GenerationStats) -> None:
        """Store the last generation's statistics for `farm status`."""
        self._last = progress

    def _events(self) -> list[Event]:
        """Events that arrived; waits for one until the next deadline at most."""
        due = self._ledger.scheduler.next_deadline(time.monotonic())
        return self._mail.events(_WAIT if due is None else max(0.001, min(due, _WAIT)))

    def _take(self, event: Event) -> None:
        ignored = self.notices.ignored.total()
        try:
            if event.topic == "want":
                self._asked(event)
            elif event.topic == "worker":
                self._liveliness(event)
            elif event.topic == FLOOD:
                self._mail.cut_off(event.key)
            elif event.topic == CHECKED:
                pass  # it has only woken us: findings are taken between rounds' events
            else:
                self._result(event)
        except MessageError as error:
            self.notices.ignore(error.kind, f"on {event.key}: {error}")
        if event.topic == "want" or self.notices.ignored.total() > ignored:
            self._mail.burden(event)

    def _asked(self, event: Event) -> None:
        sender = self._mail.sender(event)
        try:
            want = self._mail.request(event)
        except MessageError as error:
            # A worker of another release cannot read the refusal either, but it logs that. A sender
            # that already takes part has our release, so this message is not its own.
            if error.kind == "version" and sender not in self._ledger.scheduler.workers:
                self._refuse(sender, str(error))
            raise
        if want.worker != sender:
            self.notices.ignore("foreign", f"of {want.worker} from {sender}")
        elif self._workforce.asked(want, time.monotonic()):
            self._admit(want)

    def _admit(self, want: WorkRequest) -> None:
        reason = self.admission.refusal(want)
        if reason is not None:
            self._refuse(want.worker, reason)
            return
        if self._workforce.is_declined(want.worker):
            return
        if want.worker not in self._ledger.scheduler.workers:
            log.info("worker %s joined (release %s)", want.worker, want.version)
        now, idle = time.monotonic(), self._mail.run in want.idle
        self._ledger.scheduler.want(want.worker, want.credits, now, idle=idle)
        self._heard(want.worker)
        self._workforce.join(want, now)

    def _refuse(self, worker: str, reason: str) -> None:
        """Log the refusal here, and send it to the worker each time it asks, in case a message was
        lost.
        """
        self.notices.once(f"worker {worker} is refused: {reason}")
        self._ledger.lost(worker)
        self._workforce.refuse(worker, reason)
        self._mail.refuse(worker, reason)

    def _liveliness(self, event: Event) -> None:
        worker = self._mail.sender(event)
        if event.alive:
            self._arrived(worker)
            return
        self._workforce.left(worker)
        if worker in self._ledger.scheduler.workers:
            again = self._ledger.lost(worker)
            log.info(
                "worker %s left%s", worker, f"; {again} of its jobs are sent again" if again else ""
            )

    def _arrived(self, worker: str) -> None:
        early = self._workforce.arrived(worker)
        if early is not None:
            self._admit(early)

    def _look_who_is_there(self) -> None:
        """Query the tokens of workers that ask for work without one."""
        now = time.monotonic()
        for worker in self._workforce.without_token(_LOOKS):
            if self._mail.present(worker):
                try:
                    self._arrived(worker)
                except MessageError as error:
                    self.notices.ignore(error.kind, f"of {worker}: {error}")
        for worker in self._workforce.absent(now):
            self.notices.ignore("absent", f"of {worker}, whose liveliness token is missing")

    def _result(self, event: Event) -> None:
        sender = self._mail.sender(event)
        if self._workforce.is_refused(sender):
            raise MessageError("a result of a worker that is not admitted", "refused")
        # Before it is decoded: a flood must cost little
        if kind := self._ledger.scheduler.unread(sender):
            raise MessageError("a result of a worker without jobs of this round", kind)
        message = self._mail.answer(event)
        header = self._mail.header
        if message.worker != sender or message.run != header.run:
            self.notices.ignore("foreign", f"of {message.worker} on {event.key}")
        elif (message.incarnation, message.round) != (header.incarnation, header.round):
            self.notices.ignored["stale"] += 1
            self._heard(sender)
        elif isinstance(message, Failure):
            self._failed(message)
            self._heard(sender)
        else:
            self._count(message)
            self._heard(sender)

    def _heard(self, worker: str) -> None:
        self._workforce.heard(
            worker, time.monotonic(), waiting=self._ledger.scheduler.holds(worker)
        )

    def _look_for_silence(self) -> None:
        """Say which workers have not answered for long; end and replace those of this machine.

        Raises:
          RunError: that happens again and again.
        """
        for worker, silence, over in self._workforce.silent(
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
            elif self._replace(worker):
                log.warning(
                    "worker %s has not answered for %.0f s, at %s: it is replaced",
                    worker,
                    seconds,
                    what,
                )
                if self._workforce.replace(self._mail.header.round):
                    raise RunError(
                        f"{self._workforce.replaced} workers had to be replaced because they did"
                        f" not answer, the last after {seconds:.0f} s at {what}: the task hangs"
                    )

    def _count(self, message: Results) -> None:
        now = time.monotonic()
        verdicts = self._ledger.put(message, now)
        if not verdicts:
            raise MessageError("results that do not fit their jobs", "bad")
        self.notices.ignored.update(
            verdict for verdict in verdicts if verdict not in ("new", "tried")
        )
        # No notice about a worker that was lost meanwhile
        if "unasked" in verdicts and message.worker in self.workers:
            self.notices.once(
                f"worker {message.worker} sent results of jobs that it was not given; they are"
                " ignored"
            )
        self._workforce.did(message.worker, len(message.returns), now)
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
        for worker in self._workforce.expel(host, reason):
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
            seed = self._ledger.round.jobs.take([failure.index]).seeds()[0]
            error = RunError(
                f"job {failure.index} of generation {self._mail.header.generation} (seed {seed})"
                f" failed wherever it was tried, last with {failure.error}"
            )
            self._doubt(failure.index, error)

    def _doubt(self, index: int, error: RunError) -> None:
        """A job has failed wherever it was tried: let the checker try it, if there are workers of
        other machines among those that say so.
        """
        workers = self._ledger.scheduler.failed_at(index)
        # With devices, a simulation says nothing about theirs
        if (
            self._checker is None
            or self.admission.any_rounding
            or not any(map(self._source, workers))
        ):
            raise error
        doubt = self._mail.header.round, index
        if doubt not in self._doubted:
            self._doubted[doubt] = error, workers
            nobody = Source("", self.admission.fingerprint)
            job = self._ledger.round.jobs.take([index])
            self._to_try.append(Check(nobody, self._mail.header, job, b""))

    def _tried(self, check: Check, finding: Finding) -> None:
        """The checker has tried a job that failed everywhere else."""
        index = int(check.job.indices[0])
        error, workers = self._doubted.pop((check.header.round, index))
        if finding != "unknown":
            for worker in workers:
                self._decline(worker, f"it failed at job {index}, which the checker can do")
        elif check.header is self._mail.header:  # otherwise others have done it meanwhile
            raise error

    def _source(self, worker: str) -> Source | None:
        """Where a worker's answers come from; None if they are not to be checked: of this machine,
        or of a device.
        """
        if self.local is not None and self.local.pid_of(worker) is not None:
            return None
        any_rounding = self.admission.any_rounding
        digest = self._workforce.fingerprint(worker) if any_rounding else self.admission.fingerprint
        return Source(host(worker), digest) if digest else None

    def _give_checks(self) -> None:
        """Give the checker what it has room for."""
        if self._checker is None or not (room := self._checker.room):
            return
        checks = self._to_try[:1] or self._ledger.audit.take(room)
        del self._to_try[:1]
        if checks:
            self._checker.give(checks)

    def _take_findings(self) -> None:
        """Take in what the checker has found. Not while a round begins: a host that is expelled
        then would take traces from results that are still in use.
        """
        if self._checker is None:
            return
        for check, finding in self._checker.findings():
            if not check.source.host:
                self._tried(check, finding)
                continue
            if finding == "unknown":
                self.notices.once(
                    f"answers of host {check.source.host} are not checked:"
                    f" {self._checker.trouble}; --checker names a machine that can"
                )
            if name := self._ledger.audit.found(check, finding):
                job = f"job {check.job.indices[0]} of generation {check.header.generation}"
                self._expel(name, f"host {name} gave other numbers than the checker for {job}")
        self._give_checks()

    @property
    def _settled(self) -> bool:
        """Whether all checks are made."""
        return self._checker is None or self._ledger.audit.settled

    def _decline(self, worker: str, reason: str, traceback: tuple[str, ...] = ()) -> None:
        """A connected worker cannot build the task, or may not serve it, or fails; a different
        one may be better.
        """
        if worker in self._ledger.scheduler.workers:
            self.notices.once(f"worker {worker} does not serve this run: {reason}", traceback)
            self._ledger.scheduler.declined(worker)
            self._workforce.decline(worker, reason)

    def _send(self, jobs: Iterable[tuple[str, Sequence[int]]]) -> None:
        """Send jobs, by worker, to their inboxes."""
        generation = self._mail.header.generation
        for worker, indices in jobs:
            self._workforce.given(worker, indices[0], generation, time.monotonic())
            for part in self._ledger.round.messages(indices):
                self._mail.send(worker, self._ledger.round.jobs.take(part))

    def _refresh_status(self) -> None:
        if self._mail.status.due:
            self._look_who_is_there()
            self._mail.status.make(self._run_status)

    def _run_status(self) -> RunStatus:
        last = self._last
        ignored = self.notices.ignored + Counter(flood=self._mail.dropped)
        return RunStatus(
            run=self._mail.run,
            generation=self._mail.header.generation,
            generations=self._generations,
            return_mean=last.return_mean if last else None,
            mean_policy_return=last.mean_policy_return if last else None,
            open=self._ledger.scheduler.remaining,
            reissued=self.reissued,
            refused=len(self._workforce.reasons),
            ignored=dict(ignored),
            workers=self.census(),
            fingerprint=self.admission.fingerprint,
        )

    def _end_if_nobody_can_come(self) -> None:
        """Say how workers join if there are none.

        Raises:
          RunError: the run's own workers do not take part; no others can join, as its port is not
              announced.
        """
        now = time.monotonic()
        if self._ledger.scheduler.workers:
            self._alone_since = now
        elif now - self._alone_since > _PATIENCE and self._join is None:
            if self._workforce.reasons:
                raise RunError(f"no worker takes part: {self._workforce.reasons[0]}")
        elif now - self._alone_since > _PATIENCE:
            log.warning("no workers; start some with: %s", self._join)
            self._alone_since = float("inf")

    def _tend(self) -> None:
        """Restart local workers that died; raises RunError if none keeps running."""
        if self.local and self.local.tend() and not self.local.pids:
            raise RunError("no local worker keeps running; see their messages above")

    def _replace(self, worker: str) -> bool:
        """End the process of a local worker, which is then replaced; false if it is none of
        them.
        """
        pid = None if self.local is None else self.local.pid_of(worker)
        return pid is not None and self.local is not None and self.local.kill(pid)


@contextmanager
def open_pool(
    connection: Connection,
    served: Served,
    name: str,
    admission: Admission,
    *,
    generations: int = 0,
    steps: bool = False,
) -> Iterator[Pool]:
    """Show what is simulated on the network under a name, and start the workers of this machine.

    Args:
      connection: to the workers.
      served: what they simulate.
      name: of the run.
      admission: decides which workers may take part.
      generations: number of generations of the run, for `farm status`.
      steps: whether all rounds have traces of whole control steps.
    """
    place = connection.place
    spec = served.specification(name)
    mail = Mail(connection.session, place.farm, spec, served.assets)
    if place.tls:
        mail.offer_code(served.sources)
    join = None if place.workers else how_to_join(place, served.files)

    def begin(folder: Path) -> Begin:
        """Thread: the checker's."""
        for digest, content in served.assets.items():
            (folder / digest).write_bytes(content)
        files = tuple(str(path.absolute()) for path in served.files)
        return Begin(spec=spec, files=files, assets=str(folder), backend="cpu", fingerprint=True)

    def wake() -> None:
        """Thread: the checker's."""
        connection.session.events.put(Event(CHECKED, "", b""))

    with ExitStack() as stack:
        checker = stack.enter_context(closing(Checker(begin, place.checker, wake)))
        pool = Pool(
            connection,
            mail,
            served.shapes(steps=steps),
            admission,
            generations=generations,
            join=join,
            checker=checker,
        )
        if place.workers:
            flags = local_flags(place, served.files)
            pool.local = stack.enter_context(LocalWorkers(place.workers, flags, connection.forked))
        yield pool
