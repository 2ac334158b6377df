"""A worker: joins a farm, runs the jobs of all its learners, returns the results, and leaves
cleanly.

One thread owns all state; subscriptions only fill its queue. A worker belongs to the farm,
not to a run: it builds each run's task from its specification and serves the runs in turn.
"""

import logging
import math
import os
import secrets
import socket
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from farm import __version__, fingerprint
from farm.errors import MessageError, UnservedError, described
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Refusal, WorkRequest
from farm.net.notices import Notices
from farm.net.session import Session, connect
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader
from farm.runner import is_exact, make_backend, told
from workers.config import WorkerConfig
from workers.inbox import Inbox
from workers.queries import ASK, Queries
from workers.runners import AnyRunner, Runners, is_defect

log = logging.getLogger(__name__)

IDLE: Final = 1.0
"""A worker that has had no work of a run for this long reports it, and repeats the report at this
interval [s].
"""

_LOOK: Final = 5.0  # [s] without a learner on our farm, after which we look for the reason
_REST: Final = 0.2  # [s] to wait for events at a time
_HEADER: Final = 0.005  # [s] the same while jobs wait for their header, which does not wake us up


def work(config: WorkerConfig, stopped: Callable[[], bool]) -> None:
    """Serve the farm until stopped.

    Raises:
      FarmError: no learner or router answered within the timeout.
    """
    with connect(config.endpoints, config.timeout, stopped, config.bundle) as session:
        worker = Worker(config, session)
        try:
            worker.join()
            suffix = "" if config.farm == keys.FARM else f" farm {config.farm}"
            log.info("joined%s as %s", suffix, worker.id)
            if config.accept_code:
                log.warning(
                    "--accept-code: learners of %s run their code here, as this user",
                    keys.called(config.farm),
                )
            while not stopped():
                worker.turn()
            worker.leave()
        finally:
            worker.close()


class Worker:
    """A worker's reaction to each event."""

    def __init__(self, config: WorkerConfig, session: Session) -> None:
        """Choose a unique identity."""
        self.id = f"{config.name}/{os.getpid()}-{secrets.token_hex(3)}"
        self._session, self._farm = session, config.farm
        self._certified = config.bundle is not None
        self._name = config.name
        backend = make_backend(config.backend)
        self._fingerprint = fingerprint.digest() if is_exact(backend) else ""
        self._credits = 2 * backend.capacity
        self._notices, self._queries = Notices(log), Queries(session)
        self.inbox = Inbox(self._credits)
        """What learners have sent."""
        self.runners = Runners(config, backend, self._queries, self._notices)
        """The tasks of their runs."""
        self._spoke = time.monotonic()
        self._look = time.monotonic() + _LOOK

    def join(self) -> None:
        """Subscribe, then declare the token: in that order, or the first jobs are lost."""
        # A header alone needs no action; its jobs arrive a moment later: one wake-up instead of
        # two.
        self._session.subscribe("generation", keys.generation(self._farm, "*"), wake=False)
        self._session.subscribe("inbox", keys.inbox(self._farm, self.id))
        self._session.subscribe("refused", keys.refused(self._farm, self.id))
        self._session.watch("learner", keys.learner_token(self._farm, "*"))
        self._session.token(keys.worker_token(self._farm, self.id))

    def turn(self) -> None:
        """Handle the events that arrived, then run one chunk or wait for more."""
        for event in self._events():
            try:
                self._take(event)
            except MessageError as error:
                self._notices.ignore(error.kind, f"on {event.key}: {error}")
        for chunk in self.inbox.overdue(time.monotonic()):
            try:
                self._ask_round_of(chunk)
            except MessageError as error:
                self._notices.ignore(error.kind, f"of run {chunk.run}: {error}")
        self._tell_idle()
        self._look_around()
        waiting = self.inbox.next()
        if waiting is not None:
            self._run(*waiting)

    def leave(self) -> None:
        """Return all unfinished jobs; finished results arrive first."""
        self._want(idle=self.inbox.runs, credits=0)

    def close(self) -> None:
        """Stop the processes that execute received code, and delete the code."""
        self.runners.close()

    def _events(self) -> list[Event]:
        """The queued events, headers first; waits briefly if there is nothing to do."""
        patience = 0.0 if self.inbox.working else _HEADER if self.inbox.expecting else _REST
        events = self._session.events.waiting(patience)
        return sorted(events, key=lambda event: event.topic == "inbox")

    def _take(self, event: Event) -> None:
        if event.topic == "generation":
            self.inbox.begin(codec.decode(event.payload, RoundHeader))
        elif event.topic == "inbox":
            self._accept(codec.decode(event.payload, Chunk))
        elif event.topic == "refused":
            refusal = codec.decode(event.payload, Refusal)
            self._notices.once(
                f"run {refusal.run} does not take this worker: {refusal.reason}",
                level=logging.ERROR,
            )
        else:
            self._learner(
                keys.run_in(event.key, keys.learner_token(self._farm, "")), present=event.alive
            )

    def _learner(self, run: str, *, present: bool) -> None:
        """A run's learner joined or left."""
        if present:
            self._look = math.inf
            self.inbox.of(run)
            self._queries.came(run)
            self._want(idle=())
            return
        self._queries.left(run)
        header = self.inbox.left(run)
        if header is not None:
            self.runners.left(header)
            log.info(
                "run %s: its learner left after %d generations; waiting for the next one",
                run,
                header.generation,
            )

    def _tell_idle(self) -> None:
        """Report the runs that have left us without jobs, so that their learners reissue lost ones.

        Without any work, announce ourselves: this also reaches a learner whose token we missed.
        """
        now = time.monotonic()
        idle = self.inbox.idle(now, IDLE)
        if idle or (not self.inbox.working and now - self._spoke >= IDLE):
            self._want(idle=idle)

    def _look_around(self) -> None:
        """Log once why this farm has had no learner for a while: other farms have some, so --farm
        may be wrong; or, with certificates, who listens does not admit this machine.
        """
        if self.inbox.runs or time.monotonic() < self._look:
            return
        self._look = math.inf
        farms = {
            key.partition("/")[0] for key in self._session.tokens(keys.learner_token("*", "*"), ASK)
        }
        if farms and self._farm not in farms:
            others = ", ".join(sorted(farms))
            self._notices.once(
                f"no learner on {keys.called(self._farm)}; learners are on {others}: see --farm"
            )
        elif not farms and self._certified:
            self._notices.once(
                f"connected, but no learner of {keys.called(self._farm)} is seen: there is none, or"
                f" what listens does not admit {self._name}, because its roster.json had no such"
                f" name when it started: farm certificates add CERTS --worker {self._name}, then"
                " start it again (a learner with --resume RUN)"
            )

    def _accept(self, chunk: Chunk) -> None:
        """Keep a chunk if its round's header is here or on its way; else ask for the header."""
        if self.inbox.of(chunk.run).holds_round_of(chunk):
            self.inbox.put(chunk)
        elif not self.inbox.keep_early(chunk, time.monotonic()):
            self._ask_round_of(chunk)

    def _ask_round_of(self, chunk: Chunk) -> None:
        """Keep a chunk, if its learner confirms its round.

        Of a learner with certificates few questions per second get through: whoever asks for each
        header loses chunks.
        """
        run = self.inbox.of(chunk.run)
        payload = self._queries.ask(chunk.run, keys.generation(self._farm, chunk.run))
        if payload is not None:
            self.inbox.begin(codec.decode(payload, RoundHeader), asked=True)
        if run.holds_round_of(chunk):
            self.inbox.put(chunk)
            return
        self._notices.ignored["stale"] += 1
        if run.header is None or chunk.round > run.header.round:
            self._notices.once(
                f"run {chunk.run}: jobs of a round that is not announced yet are left out, and come"
                " again; this happens when a learner starts again",
                level=logging.INFO,
            )

    def _run(self, header: RoundHeader, chunk: Chunk) -> None:
        runner = self.runners.of(header)
        state = self.inbox.of(chunk.run)
        state.busy = time.monotonic()
        if runner is None:
            return
        if isinstance(runner, Exception):
            self._fail(chunk, None, runner)
            return
        size = runner.size
        if len(header.mu) != size or (len(chunk.eps) and chunk.eps.shape[1] != size):
            log.warning("ignored jobs of run %s: not %d parameters", chunk.run, size)
            return
        jobs = chunk.take(np.argsort(chunk.indices).tolist())
        try:
            self._do(chunk, runner, header, jobs)
        except UnservedError as error:  # concerns every job of the run
            self.runners.unserved(header, error)
            self._fail(chunk, None, error)
        except Exception as error:  # other workers may succeed: the learner decides
            text = (
                f"a chunk of run {chunk.run} failed ({described(error)}); trying its jobs one"
                " by one"
            )
            if is_defect(error):
                self._notices.once(text, level=logging.ERROR, error=error)
            else:
                self._notices.once(text, level=logging.INFO)
            for at, index in enumerate(jobs.indices.tolist()):
                try:
                    self._do(chunk, runner, header, jobs.take([at]))
                except Exception as error:
                    self._fail(chunk, index, error)
        state.busy = time.monotonic()

    def _do(self, chunk: Chunk, runner: AnyRunner, header: RoundHeader, jobs: Jobs) -> None:
        """Run some of a chunk's jobs and publish the results."""
        start = time.monotonic()
        simulated = runner.run(
            header.mu, jobs, header.traces, header.normaliser, terms=header.terms
        )
        self._answer(
            chunk, Results.carrying(simulated, jobs, time.monotonic() - start, **self._head(chunk))
        )

    def _fail(self, chunk: Chunk, index: int | None, error: Exception) -> None:
        self._answer(chunk, Failure(index=index, **told(error), **self._head(chunk)))

    def _head(self, chunk: Chunk) -> dict[str, Any]:
        """The fields that every answer to a chunk begins with."""
        return {
            "run": chunk.run,
            "incarnation": chunk.incarnation,
            "round": chunk.round,
            "worker": self.id,
        }

    def _answer(self, chunk: Chunk, message: Results | Failure) -> None:
        self._session.publish(keys.result(self._farm, chunk.run, self.id), codec.encode(message))

    def _want(self, *, idle: tuple[str, ...], credits: int | None = None) -> None:
        self._spoke = time.monotonic()
        message = WorkRequest(
            worker=self.id,
            credits=self._credits if credits is None else credits,
            idle=idle,
            version=__version__,
            fingerprint=self._fingerprint,
            host=socket.gethostname(),
            cores=os.cpu_count() or 1,
            ignored=dict(self._notices.ignored),
        )
        self._session.publish(
            keys.want(self._farm, self.id), codec.encode(message), urgent=not idle
        )
