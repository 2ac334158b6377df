"""A worker: joins a farm, runs the jobs of all its learners, returns the results, and leaves cleanly.

One thread owns all state; subscriptions only fill its queue. A worker belongs to the farm,
not to a run: it builds each run's task from its specification and serves the runs in turn.
"""

import hashlib
import logging
import math
import os
import secrets
import socket
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from farm import __version__, plugins, rollouts
from farm.errors import ConfigError, FarmError, MessageError, UnservedError, brief
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.messages import Refusal, Spec, WorkRequest
from farm.net.session import Session, check_endpoint, connect
from farm.net.tls import Bundle, find
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader
from farm.rollouts import Runner, served
from farm.settings import Settings, setting
from workers import fingerprint
from workers.runner_process import Begin
from workers.source_cache import SourceCache
from workers.subprocess_runner import RunnerProcess, SubprocessRunner

log = logging.getLogger(__name__)

IDLE: Final = 1.0
"""A worker that has had no work of a run for this long reports it, and repeats the report at this interval [s]."""

_ASK: Final = 1.0  # [s] for an answer to a query
_FETCH: Final = 10.0  # [s] for a source, up to 1 MB
_KEEP: Final = 32  # built tasks that are kept: this many learners can share a worker
_PROCESSES: Final = 8  # that execute received code; about 80 MB each
_RUNS: Final = 1000  # that are served at the same time
_HELD: Final = 1000  # chunks of one run; credits keep an honest learner far below it
_CREDITS: Final = 4  # jobs held per job requested, of one run: jobs may be sent twice, or while a request is on its way
_TELL: Final = 1000  # different messages that are logged once
_MEMORY: Final = 256 << 20  # [bytes] of all runs' means and chunks that wait
_LOOK: Final = 10.0  # [s] without a learner on our farm, after which we look for other farms
_MUTE: Final = 9.0  # after an unanswered query, the next is sent this many times its duration later


@dataclass(frozen=True, kw_only=True)
class WorkerConfig(Settings):
    """A worker's settings."""

    connect: tuple[str, ...] = ()
    """Where a learner or a router listens, repeatable; by default tcp/127.0.0.1:7447."""
    farm: str = "farm"
    """Name of the farm: learners and workers of one name work together."""
    name: str = ""
    """Name of this worker; by default the host's, with --tls the certificate's."""
    tls: Path | None = None
    """Folder with certificates (farm certificates makes it); needed to connect to tls/HOST:PORT."""
    timeout: float | None = setting(None, least=0.0)
    """Give up if no learner or router answers for this long at the start [s]; by default keep trying."""
    backend: str = "cpu"
    """Simulation backend: a name (farm tasks lists them), or FILE.py:CLASS."""
    allow_file: tuple[Path, ...] = ()
    """Serve runs whose task or policy is a class in this file, repeatable; the learner's must be the same file."""
    accept_code: bool = False
    """Serve runs whose task or policy is a class in a file that the learner sends; with --tls."""

    def __post_init__(self) -> None:
        """Check every value, and fill in the name and the endpoint."""
        super().__post_init__()
        bundle = self.bundle
        if bundle is not None:
            object.__setattr__(self, "name", bundle.name)
        if not self.name:
            host = socket.gethostname().split(".")[0]
            object.__setattr__(self, "name", "".join(c if c.isascii() and c.isalnum() else "-" for c in host) or "host")
        if not self.connect:
            object.__setattr__(self, "connect", (f"{'tcp' if self.tls is None else 'tls'}/127.0.0.1:7447",))
        for endpoint in self.connect:
            check_endpoint(endpoint, encrypted=self.tls is not None)
        keys.checked("farm", self.farm)
        keys.checked("worker", self.name)
        rollouts.backend(self.backend)
        if self.accept_code and self.tls is None:
            raise ConfigError("--accept-code needs --tls: without certificates anyone could send code")
        for path in self.allow_file:
            if not path.is_file():
                raise ConfigError(f"--allow-file {path}: there is no such file")

    @property
    def bundle(self) -> Bundle | None:
        """The worker's certificates."""
        return None if self.tls is None else find(self.tls, "worker", self.name)


@dataclass
class _Served:
    """A worker's state for one run."""

    header: RoundHeader | None = None
    chunks: deque[Chunk] = field(default_factory=deque)
    busy: float = field(default_factory=time.monotonic)
    """When it last had work, or when we last reported that it has none [s]."""
    there: bool = False
    """Whether its learner's token has been seen."""
    mute: float = 0.0
    """No queries to its learner before this time, because it did not answer [s]."""


def work(config: WorkerConfig, stopped: Callable[[], bool]) -> None:
    """Serve the farm until stopped.

    Raises:
      FarmError: no learner or router answered within the timeout.
    """
    with connect(config.connect, config.timeout, stopped, config.bundle) as session:
        worker = Worker(config, session)
        try:
            worker.join()
            log.info("joined farm %s as %s", config.farm, worker.id)
            if config.accept_code:
                log.warning("--accept-code: learners of farm %s run their code here, as this user", config.farm)
            while not stopped():
                worker.turn()
            worker.leave()
        finally:
            worker.close()


class Worker:
    """The state of a worker and its reaction to each event."""

    def __init__(self, config: WorkerConfig, session: Session) -> None:
        """Choose a unique identity."""
        self.id = f"{config.name}/{os.getpid()}-{secrets.token_hex(3)}"
        self._config = config
        self._session = session
        self._runs: OrderedDict[str, _Served] = OrderedDict()
        self._runners: OrderedDict[str, Runner | SubprocessRunner | Exception] = OrderedDict()
        self._sources = SourceCache()
        self._spare: RunnerProcess | None = None  # started in advance: imports take half a second
        self._backend = rollouts.backend(config.backend)
        self._canary = fingerprint.digest() if rollouts.exact(self._backend) else ""
        self._credits = 2 * self._backend.capacity
        self._mute = 0.0  # like _Served.mute, for all runs whose token was not seen
        self._spoke = time.monotonic()
        self._told: set[str] = set()
        self._look = time.monotonic() + _LOOK
        self._ignored: Counter[str] = Counter()

    def join(self) -> None:
        """Subscribe, then declare the token: in that order, or the first jobs are lost."""
        farm = self._config.farm
        if self._config.accept_code:
            self._spare = RunnerProcess(self._sources.empty)
        # A header alone needs no action; its jobs arrive a moment later: one wake-up instead of two.
        self._session.subscribe("generation", keys.generation(farm, "*"), wake=False)
        self._session.subscribe("inbox", keys.inbox(farm, self.id))
        self._session.subscribe("refused", keys.refused(farm, self.id))
        self._session.watch("learner", keys.learner_token(farm, "*"))
        self._session.token(keys.worker_token(farm, self.id))

    def turn(self) -> None:
        """Handle the events that arrived, then run one chunk or wait for more."""
        for event in self._events():
            try:
                self._take(event)
            except MessageError as error:
                self._ignored[error.kind] += 1
                self._tell(logging.WARNING, f"ignored a message on {event.key}: {error}")
        self._tell_idle()
        self._look_around()
        chunk = self._next()
        if chunk is not None:
            self._run(chunk)

    def leave(self) -> None:
        """Return all unfinished jobs; finished results arrive first."""
        self._want(idle=tuple(self._runs), credits=0)

    def close(self) -> None:
        """Stop the processes that execute received code, and delete the code."""
        for runner in self._runners.values():
            if not isinstance(runner, Exception):
                runner.close()
        if self._spare is not None:
            self._spare.close()
        self._sources.close()

    def _events(self) -> list[Event]:
        """The queued events, headers first; waits briefly if there is nothing to do."""
        working = any(run.chunks for run in self._runs.values())
        events = self._session.events.waiting(0.0 if working else 0.2)
        return sorted(events, key=lambda event: event.topic == "inbox")

    def _take(self, event: Event) -> None:
        if event.topic == "generation":
            self._begin(codec.decode(event.payload, RoundHeader))
        elif event.topic == "inbox":
            self._accept(codec.decode(event.payload, Chunk))
        elif event.topic == "refused":
            refusal = codec.decode(event.payload, Refusal)
            self._tell(logging.ERROR, f"run {refusal.run} does not take this worker: {refusal.reason}")
        else:
            self._learner(keys.run_in(event.key, keys.learner_token(self._config.farm, "")), there=event.alive)

    def _learner(self, run: str, *, there: bool) -> None:
        """A run's learner joined or left."""
        if not there:
            gone = self._runs.pop(run, None)
            made = self._runners.get(gone.header.spec) if gone and gone.header else None
            if gone and gone.header and isinstance(made, SubprocessRunner):
                made.close()  # it is restarted if the learner comes back
                del self._runners[gone.header.spec]
            return
        self._served(run).there = True
        self._want(idle=())

    def _tell_idle(self) -> None:
        """Report the runs that have left us without jobs, so that their learners reissue lost ones.

        Without any work, announce ourselves: this also reaches a learner whose token we missed.
        """
        now, working = time.monotonic(), any(run.chunks for run in self._runs.values())
        idle = [name for name, run in self._runs.items() if not run.chunks and now - run.busy >= IDLE]
        for name in idle:
            self._runs[name].busy = now
        if idle or (not working and now - self._spoke >= IDLE):
            self._want(idle=tuple(idle))

    def _look_around(self) -> None:
        """If our farm has had no learner for a while, log once which farms have one: --farm may be wrong."""
        if self._runs or time.monotonic() < self._look:
            return
        self._look = math.inf
        seen = {key.partition("/")[0] for key in self._session.tokens(keys.learner_token("*", "*"), _ASK)}
        if seen and self._config.farm not in seen:
            text = f"no learner on farm {self._config.farm}; learners are on {', '.join(sorted(seen))}: see --farm"
            self._tell(logging.WARNING, text)

    def _tell(self, level: int, text: str, error: Exception | None = None) -> None:
        """Log a message once, perhaps with an error's traceback."""
        text = brief(text)
        if text not in self._told and len(self._told) < _TELL:
            self._told.add(text)
            log.log(level, "%s", text, exc_info=error)

    def _begin(self, header: RoundHeader, *, asked: bool = False) -> None:
        """Start a new round and drop work of older ones. A header that we asked for overrides published ones."""
        run = self._served(header.run)
        old = run.header
        if old and old.incarnation == header.incarnation:
            if header.round == old.round or (header.round < old.round and not asked):
                return
        self._make_room(header)
        run.header, run.busy = header, time.monotonic()
        run.chunks.clear()

    def _accept(self, chunk: Chunk) -> None:
        run = self._served(chunk.run)
        if not _belongs(chunk, run.header):
            payload = self._ask(run, keys.generation(self._config.farm, chunk.run))
            if payload is not None:
                self._begin(codec.decode(payload, RoundHeader), asked=True)
        if not _belongs(chunk, run.header):
            self._ignored["stale"] += 1
            if run.header is None or chunk.round > run.header.round:
                self._tell(logging.WARNING, f"run {chunk.run} sends jobs of a round that its learner does not confirm")
            return
        jobs = len(chunk) + sum(map(len, run.chunks))
        if jobs > _CREDITS * self._credits or len(run.chunks) >= _HELD:
            raise MessageError(f"run {chunk.run} sends {jobs} jobs, {self._credits} were asked for", "large")
        self._make_room(chunk)
        run.chunks.append(chunk)

    def _ask(self, run: _Served, key: str, seconds: float = _ASK) -> bytes | None:
        """The answer of a run's learner, or None; waiting for missing answers takes at most a tenth of our time."""
        begun = time.monotonic()
        if begun < (run.mute if run.there else self._mute):
            return None
        payload = self._session.ask(key, seconds)
        if payload is None:
            now = time.monotonic()
            run.mute = self._mute = now + _MUTE * (now - begun)
        return payload

    def _served(self, run: str) -> _Served:
        """Our state for a run, created on first use.

        Raises:
          MessageError: the name is malformed, or there are too many runs.
        """
        try:
            keys.checked("run", run)
        except ConfigError as error:
            raise MessageError(str(error)) from None
        if run not in self._runs and len(self._runs) >= _RUNS:
            raise MessageError(f"run {run[:40]}: {_RUNS} runs are served already", "large")
        return self._runs.setdefault(run, _Served())

    def _make_room(self, message: RoundHeader | Chunk) -> None:
        """Make sure that a message fits into memory: drop other runs' messages, oldest first; they are requested again.

        Raises:
          MessageError: its own run alone holds too much.
        """
        sizes = {
            name: sum(map(_bytes, [*run.chunks, *([run.header] if run.header else [])]))
            for name, run in self._runs.items()
        }
        total = sum(sizes.values()) + _bytes(message)
        for name, run in self._runs.items():
            if total > _MEMORY and name != message.run:
                total -= sizes[name]
                run.header = None
                run.chunks.clear()
        if total > _MEMORY:
            raise MessageError(f"run {message.run} wants more than {_MEMORY >> 20} MiB kept", "large")

    def _next(self) -> Chunk | None:
        """A chunk of the run that has waited longest."""
        for name, run in list(self._runs.items()):
            if run.chunks:
                self._runs.move_to_end(name)
                return run.chunks.popleft()
        return None

    def _run(self, chunk: Chunk) -> None:
        header = self._runs[chunk.run].header
        assert header is not None
        runner = self._runner(header)
        self._runs[chunk.run].busy = time.monotonic()
        if runner is None:
            return
        if isinstance(runner, Exception):
            for index in [None] if isinstance(runner, UnservedError) else chunk.indices.tolist():
                self._fail(chunk, index, runner)
            return
        size = runner.size
        if len(header.mu) != size or (len(chunk.eps) and chunk.eps.shape[1] != size):
            log.warning("ignored jobs of run %s: not %d parameters", chunk.run, size)
            return
        jobs = chunk.take(np.argsort(chunk.indices).tolist())
        try:
            self._do(chunk, runner, header, jobs)
        except UnservedError as error:  # concerns every job of the run
            runner.close()
            self._runners[header.spec] = error
            self._fail(chunk, None, error)
        except Exception as error:  # other workers may succeed: the learner decides
            text = f"a chunk of run {chunk.run} failed ({type(error).__name__}: {error}); trying its jobs one by one"
            ours = _ours(error)
            self._tell(logging.ERROR if ours else logging.INFO, text, error if ours else None)
            for at, index in enumerate(jobs.indices.tolist()):
                try:
                    self._do(chunk, runner, header, jobs.take([at]))
                except Exception as error:
                    self._fail(chunk, index, error)
        self._runs[chunk.run].busy = time.monotonic()

    def _do(self, chunk: Chunk, runner: Runner | SubprocessRunner, header: RoundHeader, jobs: Jobs) -> None:
        """Run some of a chunk's jobs and publish the results."""
        given = runner.run(header.mu, jobs, header.traces, header.normaliser)
        head = {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round, "worker": self.id}
        self._answer(chunk, Results.carrying(given, jobs, **head))

    def _runner(self, header: RoundHeader) -> Runner | SubprocessRunner | Exception | None:
        """The run's task, built once; an exception if that failed; None if its specification is unavailable."""
        if header.spec not in self._runners:
            payload = self._ask(self._runs[header.run], keys.spec(self._config.farm, header.run))
            if payload is None or hashlib.sha256(payload).hexdigest() != header.spec:
                self._tell(logging.WARNING, f"run {header.run} does not send its specification; its jobs wait")
                return None
            try:
                made = self._made(header.run, codec.decode(payload, Spec))
                if made is None:
                    return None
                self._runners[header.spec] = made
                log.info("serving run %s", header.run)
            except Exception as error:  # reported to the learner, which decides
                self._tell(logging.ERROR, f"cannot serve run {header.run}: {error}", error if _ours(error) else None)
                if not isinstance(error, FarmError):
                    return error  # perhaps short of memory: it may work later
                self._runners[header.spec] = error
            self._let_go()
        self._runners.move_to_end(header.spec)
        return self._runners[header.spec]

    def _let_go(self) -> None:
        """Keep only the newest tasks, and fewer of those that are processes."""
        processes = [digest for digest, each in self._runners.items() if isinstance(each, SubprocessRunner)]
        for digest in {*processes[:-_PROCESSES], *list(self._runners)[:-_KEEP]}:
            oldest = self._runners.pop(digest)
            if not isinstance(oldest, Exception):
                oldest.close()

    def _made(self, run: str, spec: Spec) -> Runner | SubprocessRunner | None:
        """The runner of a run's jobs; None if a source file is unavailable."""
        files = list(self._config.allow_file)
        here = {(path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files if path.is_file()}
        named = {(plugins.named_file(spec.task), spec.code.get("task", "")),
                 (plugins.named_file(spec.policy), spec.code.get("policy", ""))}  # fmt: skip
        travels = sorted((name, digest) for name, digest in named - here if name)
        if not (travels and self._config.accept_code):
            return Runner(
                *served(spec, self._config.allow_file), self._backend.engine, exact=rollouts.exact(self._backend)
            )
        for name, digest in travels:
            path = self._sources.place(name, digest)
            if not path.is_file():
                source = self._ask(self._served(run), keys.code(self._config.farm, run, digest), _FETCH)
                if source is None:
                    self._tell(logging.WARNING, f"run {run} does not send the source of {name}; its jobs wait")
                    return None
                self._sources.keep(name, digest, source)
            files.insert(0, path)
            log.info("run %s: received %s (SHA-256 %s) from its learner; a separate process runs it", run, name, digest)
        begin = Begin(spec=spec, files=tuple(map(str, files)), backend=self._config.backend)
        process, self._spare = self._spare, None
        try:
            return SubprocessRunner(begin, self._sources.empty, process)
        finally:
            self._spare = RunnerProcess(self._sources.empty)

    def _fail(self, chunk: Chunk, index: int | None, error: Exception) -> None:
        lines = error.traceback if isinstance(error, FarmError) and error.traceback else plugins.author_traceback(error)
        text = str(error) if isinstance(error, FarmError) else f"{type(error).__name__}: {error}"
        head = {"run": chunk.run, "incarnation": chunk.incarnation, "round": chunk.round, "worker": self.id}
        self._answer(chunk, Failure(index=index, error=brief(text), traceback=lines, **head))

    def _answer(self, chunk: Chunk, message: Results | Failure) -> None:
        self._session.publish(keys.result(self._config.farm, chunk.run, self.id), codec.encode(message))

    def _want(self, *, idle: tuple[str, ...], credits: int | None = None) -> None:
        self._spoke = time.monotonic()
        message = WorkRequest(
            worker=self.id,
            credits=self._credits if credits is None else credits,
            idle=idle,
            version=__version__,
            canary=self._canary,
            host=socket.gethostname(),
            cores=os.cpu_count() or 1,
            ignored=dict(self._ignored),
        )
        self._session.publish(keys.want(self._config.farm, self.id), codec.encode(message), urgent=not idle)


def _ours(error: Exception) -> bool:
    """Whether an error is a defect of the farm: others are in the author's code, and its learner shows where."""
    return not isinstance(error, FarmError) and not plugins.author_traceback(error)


def _belongs(chunk: Chunk, header: RoundHeader | None) -> bool:
    return header is not None and (chunk.incarnation, chunk.round) == (header.incarnation, header.round)


def _bytes(message: RoundHeader | Chunk) -> int:
    return sum(getattr(value, "nbytes", 0) for value in vars(message).values())
