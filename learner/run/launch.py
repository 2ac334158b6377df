"""A run from Python: learner, workers and recording in one call; what `farm run` does.

import farm

for report in farm.learn(farm.RunConfig(seed=3), "runs/first", workers=2):
    print(report.progress.mean_policy_return)
"""

import importlib.util
import logging
import secrets
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from farm.commands.logs import Formatter
from farm.errors import ConfigError, NameTakenError, RunError, check_addresses
from farm.net import keys, session
from farm.net.session import Session, free_endpoint
from farm.net.telemetry import Report, RunEnd
from farm.net.tls import Bundle
from farm.net.zenoh_settings import LISTEN
from farm.processes import Forked, LocalWorkers, forks
from farm.sim.model_files import by_digest
from farm.sim.trajectory import Trajectory
from learner.algorithms import Diverged
from learner.loggers.base import Loggers
from learner.recording.files import set_aside
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.evaluation import Evaluation
from learner.run.files import with_rates
from learner.run.folder import RunFolder
from learner.run.judge import LocalJudge
from learner.run.learner import Learner
from learner.run.pilot import begun, piloted
from learner.run.setup import Problem, fitted, handed_over, resumed, start
from learner.run.states import RolledBack
from learner.scheduler.dispatcher import Dispatcher, Stopped
from learner.scheduler.membership import Admission
from learner.scheduler.scheduler import SchedulerConfig
from learner.telemetry.publisher import Publisher

if TYPE_CHECKING:
    from learner.recording.run import RunRecording

log = logging.getLogger(__name__)

_REMEMBERED: Final = 5.0  # [s] for which a router may believe that a killed learner is still there
_LOOK: Final = 0.3  # [s] between two checks for other claims on a run's name
_TEND: Final = 0.5  # [s] between two checks of the worker processes

MOST_WORKERS: Final = 1024
"""Local worker processes of a run."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Placement of a run on the network and on this machine; does not affect its numbers."""

    workers: int = 0
    """Number of local worker processes."""
    backend: str = "cpu"
    """Their simulation backend."""
    listen: str = LISTEN
    """Where the learner listens for workers."""
    connect: tuple[str, ...] = ()
    """Routers to connect to instead of listening."""
    farm: str = "farm"
    tls: Bundle | None = None
    """The learner's certificates."""
    trusted: bool = False
    """Listen to other machines without certificates."""
    numbers: str = ""
    """Canary of the machines whose numbers a new run accepts, or how it begins.

    By default this machine's.
    """
    mixed: bool = False
    """Admit workers whose machines round differently, and code that has changed since the run
    started.
    """
    record: bool = True
    """Write run.rrd and replay.rrd."""
    serve: tuple[str, int] | None = None
    """Stream live at this host and port."""
    log: tuple[str, ...] = ()
    """Loggers, by name."""
    compare: bool = True
    """Compare the result of a run that validates with doing nothing and a constant action."""
    scheduler: SchedulerConfig = field(default_factory=SchedulerConfig)
    """How jobs are split into chunks, and when they are reissued."""


@dataclass
class Run:
    """A run that `open_run` opened: iterate over `learn`."""

    learner: Learner
    dispatcher: Dispatcher
    publisher: Publisher
    recording: "RunRecording | None"
    pool: LocalWorkers | None
    """The local workers."""
    loggers: Loggers
    compare: bool = True
    """Whether the result is compared with doing nothing."""
    summary: dict[str, Any] = field(default_factory=dict)
    """The contents of summary.json after the end."""
    _best: tuple[Trajectory | None, int] = (None, 0)

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the local workers."""
        return self.pool.pids if self.pool else []

    @property
    def live(self) -> str | None:
        """Where viewers find the live stream, if it is served."""
        return self.recording.uri if self.recording else None

    def learn(self) -> Iterator[Report]:
        """Yield generations until the run is over, each recorded; then evaluate.

        `summary` has the result.

        Raises:
          RolledBack: a host was expelled; a resume goes back to before its first answer.
          RunError: the run failed or diverged; everything is saved.
        """
        state, evaluation = "failed", None
        try:
            for report in self.learner.learn(self.dispatcher):
                if report.replay is not None:
                    self._best = report.replay, report.replay_generation
                self.publisher.generation(report)
                if self.recording:
                    self.recording.put(report)
                self.loggers.generation(report.progress)
                yield report
            evaluation = self.learner.evaluate(self.dispatcher, compare=self.compare)
            state = "finished"
        except (Stopped, GeneratorExit):
            state = "interrupted"
        except (KeyboardInterrupt, RolledBack):
            state = "interrupted"
            raise
        except Diverged as error:
            state = "diverged"
            raise RunError(f"the run diverged: {error}; everything before is saved") from None
        finally:
            self._finish(state, evaluation)

    def _finish(self, state: str, evaluation: Evaluation | None) -> None:
        workers = max(len(self.dispatcher.workers), len(self.worker_pids))
        self.summary = self.learner.summary(state, workers, evaluation)
        log.info(
            "%(state)s after %(generations)d generations, %(rollouts)d rollouts, %(seconds).0f s",
            self.summary,
        )
        try:
            self.learner.folder.write_summary(self.summary)
            self.learner.folder.settle()
            self.loggers.end(self.summary)
        except OSError as error:
            if state in ("finished", "interrupted"):  # otherwise a better reason is on its way
                raise RunError(
                    f"cannot write to {self.learner.folder.path}: {error.strerror}"
                ) from None
        finally:
            if state in ("finished", "diverged"):  # otherwise the run may continue
                self._end(evaluation)

    def _end(self, evaluation: Evaluation | None) -> None:
        if evaluation and evaluation.replay is not None:
            self._best = evaluation.replay, self.learner.best_generation
        mean = evaluation.mean.trajectory if evaluation else None
        end = RunEnd(
            summary=self.summary, best=self._best[0], best_generation=self._best[1], mean=mean
        )
        if self.recording:
            self.recording.put(end)
        self.publisher.end(end)


def learn(
    config: RunConfig,
    folder: str | Path,
    *,
    workers: int = 2,
    record: bool = False,
    log: Sequence[str] = (),
) -> Iterator[Report]:
    """Learn with local workers; the folder must not exist yet.

    `log` are loggers by name, such as "tensorboard".

    Raises:
      ConfigError: the folder exists, or a setting is invalid.
      RunError: the run failed.

    Example:
      ```python
      import farm

      config = farm.configure("finger-gait", generations=1)
      for report in farm.learn(config, "runs/first", workers=2):
          print(report.progress.generation, report.progress.mean_policy_return)
      ```
    """
    check_workers(workers)
    place = Placement(workers=workers, listen=free_endpoint(), record=record, log=tuple(log))
    with open_run(config, Path(folder), place) as run:
        yield from run.learn()


def check_workers(workers: object) -> None:
    """Check a number of local workers; raises ConfigError if it is invalid."""
    if type(workers) is not int or not 1 <= workers <= MOST_WORKERS:
        raise ConfigError(
            f"workers is {workers!r}; expected 1 to {MOST_WORKERS} processes on this machine"
        )


@contextmanager
def open_run(
    config: RunConfig,
    path: Path,
    place: Placement,
    *,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Run]:
    """Open all parts of a run, in an order that leaves nothing behind if one fails."""
    folder = RunFolder(path, configs.class_files(config))
    keys.checked("run", folder.name)
    check_addresses(2 << 30, "learning")
    if place.record or place.serve:
        check_rerun()
    with ExitStack() as stack:
        if resume:
            stack.enter_context(folder.held())
        config = begun(config, folder) if resume else _completed(config, stopped)
        if resume:
            problem, at = _resumed(folder, config, place)
        else:
            problem, at = start(config, folder.name, numbers=place.numbers)
        if place.workers:
            problem.runner().close()  # reports early what no worker could simulate
        # Devices want processes of their own.
        forked = stack.enter_context(forks(place.workers if place.backend == "cpu" else 0))
        link = stack.enter_context(connected(place, problem, stopped))
        _check_alone(link, place, folder.name, stopped)
        if not resume:
            RunFolder.create(path, config)
            stack.enter_context(folder.held())
        try:
            if resume:
                folder.rewind(at)
                folder.write_config(config)
            learner = Learner(problem, folder, at)
            recording = _recording(place, learner, stack)
            stack.enter_context(_log_file(folder))
            loggers = Loggers(place.log, path, configs.to_dict(config), at.state["generation"])
            stack.callback(loggers.end, {})  # where nothing was learnt
        except (ConfigError, OSError) as error:
            if not resume:
                folder.discard()
            if isinstance(error, OSError):
                raise RunError(f"cannot write to {folder.path}: {error.strerror}") from None
            raise
        admission = Admission(learner.canary, at.expelled, mixed=place.mixed)
        dispatcher, pool = dispatch(
            stack, link, place, problem, folder.name, admission, config.generations, stopped, forked
        )
        publisher = stack.enter_context(
            closing(Publisher(link, place.farm, dispatcher.incarnation, learner))
        )
        yield Run(learner, dispatcher, publisher, recording, pool, loggers, place.compare)


def _completed(config: RunConfig, stopped: Callable[[], bool]) -> RunConfig:
    """A new run's configuration with what is computed before it; says from what other task's run
    it begins.
    """
    if line := handed_over(config):
        log.info(line)
    return piloted(fitted(config), stopped)


def _resumed(folder: RunFolder, config: RunConfig, place: Placement) -> tuple[Problem, Checkpoint]:
    """A saved run; the recording of what it has to undo is set aside."""
    problem, at = resumed(folder, config, place.numbers, mixed=place.mixed)
    if at.undone > checkpoints.load(folder.checkpoint).undone:
        set_aside(folder.recording)
    return problem, at


def dispatch(
    stack: ExitStack,
    link: Session,
    place: Placement,
    problem: Problem,
    name: str,
    admission: Admission,
    generations: int,
    stopped: Callable[[], bool],
    forked: Sequence[Forked] = (),
    *,
    steps: bool = False,
) -> tuple[Dispatcher, LocalWorkers | None]:
    """Publish a problem on the network under a name, and start its local workers.

    The stack closes all.

    Workers are `forked` processes or new ones. With `steps` the traces of all rounds are of that
    kind.
    """
    tend = _Tending(stopped)
    for digest, source in problem.sources.items() if place.tls else ():
        link.answer(keys.code(place.farm, name, digest), partial(bytes, source))
    for digest, content in by_digest(problem.task.sources).items():
        link.answer(keys.asset(place.farm, name, digest), partial(bytes, content))
    join = None if place.workers else how_to_join(place, problem)
    spec, judge = problem.specification(name), stack.enter_context(closing(LocalJudge(problem)))
    dispatcher = Dispatcher(
        link,
        place.farm,
        spec,
        generations,
        join,
        tend,
        admission,
        problem.shapes(steps=steps),
        place.scheduler,
        judge,
        tend.end,
    )
    if place.workers:
        flags = [
            *_worker_flags(place),
            *_allowing(problem.files),
            "--backend",
            place.backend,
            "--log-level",
            "WARNING",
        ]
        # The learner reports their state
        tend.pool = stack.enter_context(LocalWorkers(place.workers, flags, forked))
    return dispatcher, tend.pool


class _Tending:
    """Called repeatedly to ask whether to stop; also restarts local workers."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped, self._next = stopped, 0.0
        self.pool: LocalWorkers | None = None

    def end(self, worker: str) -> bool:
        """End the process of a local worker, which is then replaced; false if it is none of
        them.
        """
        digits = worker.rpartition("/")[2].partition("-")[0]  # as `Worker` names itself
        return self.pool is not None and digits.isdecimal() and self.pool.kill(int(digits))

    def __call__(self) -> bool:
        if self.pool and time.monotonic() > self._next:
            self._next = time.monotonic() + _TEND
            if self.pool.tend() and not self.pool.pids:
                raise RunError("no local worker keeps running; see their messages above")
        return self._stopped()


def _check_alone(link: Session, place: Placement, run: str, stopped: Callable[[], bool]) -> None:
    """Check that no other learner has this run's name at the same router: they would discard each
    other's work.

    If several start together, the first one stays: each claims the name, then looks for other
    claims.
    """
    if not place.connect:
        return
    error = NameTakenError(
        f"a learner of run {run} is on farm {place.farm} already: choose a different --name"
    )
    until = time.monotonic() + _REMEMBERED
    while link.present(keys.learner_token(place.farm, run), 1.0):
        if time.monotonic() > until or stopped():
            raise error
    claim = f"{time.time_ns():020}-{secrets.token_hex(8)}".encode()
    link.answer(keys.claim(place.farm, run), lambda: claim)
    for pause in (0.0, _LOOK):  # again, because routers take time to forward a claim
        time.sleep(pause)
        if any(other < claim for other in link.ask_all(keys.claim(place.farm, run), 1.0)):
            raise error


def connected(
    place: Placement, problem: Problem, stopped: Callable[[], bool]
) -> AbstractContextManager[Session]:
    """A session for results of the problem: one that listens, or one connected to a router."""
    largest = problem.shapes(steps=True).largest_message
    if place.connect:
        return session.connect(place.connect, None, stopped, place.tls, largest=largest)
    return session.listen(
        place.listen, place.farm, place.tls, trusted=place.trusted, largest=largest
    )


def _worker_flags(place: Placement) -> list[str]:
    farm = ["--farm", place.farm] if place.farm != "farm" else []
    return [
        *(word for each in place.connect or (place.listen,) for word in ("--connect", each)),
        *farm,
    ]


def _allowing(files: Iterable[object]) -> list[str]:
    return [word for file in files for word in ("--allow-file", str(file))]


def how_to_join(place: Placement, problem: Problem) -> str:
    """The command with which workers join.

    A class in a file is sent to workers with certificates. Without, a worker on another machine has
    a copy of the file.
    """
    if place.tls:
        code = ["--accept-code"] if problem.files else []
    else:
        code = _allowing(path.name if place.trusted else path for path in problem.files)
    # Where the address means all of this machine's, other machines need its name
    host = socket.gethostname()
    if place.tls and place.tls.hosts and host not in place.tls.hosts:
        host = place.tls.hosts[0]  # another would be refused
    tls = ["--tls", "worker-NAME"] if place.tls else []
    command = " ".join(["farm worker", *_worker_flags(place), *tls, *code])
    return command.replace("/0.0.0.0:", f"/{host}:").replace("/[::]:", f"/{host}:")


class _LogFile(logging.FileHandler):
    """Drops lines that cannot be written; a full disk is reported elsewhere."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's name
        """Say nothing."""


@contextmanager
def _log_file(folder: RunFolder) -> Iterator[None]:
    handler = _LogFile(folder.path / "log.txt", encoding="utf-8")
    handler.setFormatter(Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        with suppress(OSError):
            handler.close()


def _recording(place: Placement, learner: Learner, stack: ExitStack) -> "RunRecording | None":
    if not (place.record or place.serve):
        return None
    from learner.recording.drawing import Drawing
    from learner.recording.files import last_generation
    from learner.recording.run import open_recording

    path, recorded = learner.folder.recording if place.record else None, 0
    # A recording that cannot be read stays as it is, and what follows is recorded beside it
    with suppress(ConfigError):
        recorded = 0 if path is None else last_generation(path)
    opened = stack.enter_context(
        open_recording(
            path,
            run=learner.run,
            config=learner.config,
            serve=place.serve,
            drawing=Drawing.of(learner.problem),
            done=learner.state.generation if recorded else 0,
            folder=learner.folder.path,
        )
    )
    # The curves of what was not recorded, or was lost when the run was killed.
    for stats, rate in with_rates(learner.folder.progress_after(recorded - 1)):
        if stats.generation > recorded:
            opened.put(Report(progress=stats, rate=rate))
    return opened


def check_rerun() -> None:
    """Check that rerun-sdk, an extra that workers do not need, is installed and can run; else a
    ConfigError.
    """
    check_addresses(4 << 30, "recording", ", and --no-record needs 2 GiB")
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError(
            "recording needs rerun-sdk: pip install 'rerun-sdk<0.42', or record nothing:"
            " --no-record"
        )
