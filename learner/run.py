"""A run from Python: learner, workers and recording in one call; what `farm run` does.

import farm

for report in farm.learn(farm.RunConfig(seed=3), "runs/first", workers=2):
    print(report.progress.mean_policy_return)
"""

import importlib.util
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from farm.errors import CheckpointError, ConfigError, RunError
from farm.net import keys, session
from farm.net.session import LISTEN, Session, free_endpoint
from farm.net.telemetry import WorkerStatus
from farm.net.tls import Bundle
from farm.processes import Pool
from learner import checkpoint as checkpoints
from learner import config as configs
from learner.algorithms import Diverged
from learner.checkpoint import Checkpoint
from learner.config import RunConfig
from learner.evaluation import Evaluation
from learner.learner import Learner
from learner.run_folder import RunFolder
from learner.scheduler.dispatcher import Dispatcher, Stopped
from learner.scheduler.membership import Admission
from learner.scheduler.scheduler import SchedulerConfig
from learner.setup import Problem, resumed, start
from learner.telemetry.publisher import Publisher
from learner.telemetry.report import Report

if TYPE_CHECKING:
    from learner.recording.run import RunRecording

log = logging.getLogger(__name__)

MESSAGE_LIMIT: Final = 32 << 20
"""What a mean may take in a message [bytes]; a chunk holds it and eps besides."""

_REMEMBERED: Final = 5.0  # [s] for which a router may believe that a killed learner is still there
_TEND: Final = 0.5  # [s] between two looks at the worker processes


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Where a run is on the network and on this machine; no number depends on it."""

    workers: int = 0
    """Local worker processes."""
    backend: str = "cpu"
    """What they simulate with."""
    listen: str = LISTEN
    """Where workers dial."""
    connect: tuple[str, ...] = ()
    """Routers to dial instead of listening."""
    farm: str = "farm"
    """Name of the farm."""
    tls: Bundle | None = None
    """The learner's certificates."""
    trusted: bool = False
    """Listen to other machines without certificates."""
    mixed: bool = False
    """Admit workers whose machines round differently, and code that has changed since the run began."""
    record: bool = True
    """Write run.rrd and replay.rrd."""
    serve: tuple[str, int] | None = None
    """Stream live at this host and port."""
    scheduler: SchedulerConfig = field(default_factory=SchedulerConfig)
    """How jobs are cut into chunks, and when they are given out again."""


class Run:
    """A run that is open: iterate over `learn`, then `finish`."""

    def __init__(
        self,
        learner: Learner,
        farm: Dispatcher,
        broadcast: Publisher,
        recording: "RunRecording | None",
        pool: Pool | None,
    ) -> None:
        """Made by `open_run`."""
        self.learner, self._farm, self._recording, self._pool = learner, farm, recording, pool
        self._broadcast = broadcast
        self.summary: dict[str, Any] = {}
        """What summary.json says, once it is over."""

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the local workers."""
        return self._pool.pids if self._pool else []

    @property
    def workers(self) -> tuple[WorkerStatus, ...]:
        """Workers that take part, with what they did lately."""
        return self._farm.census()

    @property
    def recorded(self) -> bool:
        """Whether there is a recording."""
        return self._recording is not None

    @property
    def dropped(self) -> int:
        """Generations that were recorded without their rollout, because the recorder could not keep up."""
        return self._recording.dropped if self._recording else 0

    @property
    def live(self) -> str | None:
        """Where viewers find the live stream, if it is served."""
        return self._recording.uri if self._recording else None

    def learn(self) -> Iterator[Report]:
        """Generations until the run is over, each recorded; then the evaluation. `summary` tells how it ended.

        Raises:
          RunError: the run failed or diverged; everything is saved.
        """
        state, evaluation = "failed", None
        try:
            for report in self.learner.learn(self._farm):
                self._broadcast.generation(report)
                if self._recording:
                    self._recording.generation(report)
                yield report
            evaluation = self.learner.evaluate(self._farm)
            if self._recording:
                self._recording.end(
                    self.learner.state.generation,
                    evaluation.mean.trajectory,
                    evaluation.replay,
                    self.learner.best_generation,
                )
            state = "finished"
        except (Stopped, GeneratorExit):
            state = "interrupted"
        except KeyboardInterrupt:
            state = "interrupted"
            raise
        except Diverged as error:
            state = "diverged"
            raise RunError(f"the run diverged: {error}; everything before is saved") from None
        finally:
            self._finish(state, evaluation)

    def _finish(self, state: str, evaluation: Evaluation | None) -> None:
        workers = max(len(self._farm.workers), len(self.worker_pids))
        self.summary = self.learner.summary(state, workers, evaluation)
        log.info("%(state)s after %(generations)d generations, %(rollouts)d rollouts, %(seconds).0f s", self.summary)
        try:
            self.learner.folder.write_summary(self.summary)
        except OSError as error:
            if state in ("finished", "interrupted"):  # otherwise a better reason is on its way
                raise RunError(f"cannot write to {self.learner.folder.path}: {error.strerror}") from None
        finally:
            if state in ("finished", "diverged"):  # otherwise the run may go on
                self._broadcast.end(self.summary, evaluation, self.learner.best_generation)


def learn(config: RunConfig, folder: str | Path, *, workers: int = 2, record: bool = False) -> Iterator[Report]:
    """Learn with local workers; the folder must not exist yet.

    Raises:
      ConfigError: the folder exists, or a setting makes no sense.
      RunError: the run failed.
    """
    place = Placement(workers=workers, listen=free_endpoint(), record=record)
    with open_run(config, Path(folder), place) as run:
        yield from run.learn()


@contextmanager
def open_run(
    config: RunConfig,
    path: Path,
    place: Placement,
    *,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Run]:
    """Everything a run needs, opened in an order that leaves nothing behind when a part fails."""
    folder = RunFolder(path)
    keys.checked("run", folder.name)
    if place.record or place.serve:
        check_rerun()
    with ExitStack() as stack:
        if resume:
            stack.enter_context(folder.held())
        problem, at = _resumed(folder, config, mixed=place.mixed) if resume else start(config, folder.name)
        check_size(problem)
        if place.workers:
            problem.runner().close()  # says in time what no worker could simulate
        link = stack.enter_context(_session(place, stopped))
        _check_alone(link, place, folder.name, stopped)
        if not resume:
            RunFolder.create(path, config)
            stack.enter_context(folder.held())
        try:
            if resume:
                folder.rewind(at)
                folder.write_config(config)
            learner = Learner(problem, folder, at)
            recording = stack.enter_context(_recording(place, learner)) if place.record or place.serve else None
            stack.enter_context(_log_file(folder))
        except (ConfigError, OSError) as error:
            if not resume:
                folder.discard()
            if isinstance(error, OSError):
                raise RunError(f"cannot write to {folder.path}: {error.strerror}") from None
            raise
        tend = _Tending(stopped)
        farm = Dispatcher(
            link,
            place.farm,
            learner.spec,
            config.generations,
            None if place.workers else how_to_join(place, problem),
            tend,
            Admission(learner.canary, mixed=place.mixed),
            (problem.spec.trace, problem.spec.shapes(len(problem.scene.bodies))),
            place.scheduler,
        )
        if place.workers:
            flags = [
                *_worker_flags(place, problem),
                "--backend",
                place.backend,
                "--log-level",
                "WARNING",
            ]  # what they do, the learner says
            tend.pool = stack.enter_context(Pool(place.workers, flags, dict(os.environ)))
        broadcast = stack.enter_context(closing(Publisher(link, place.farm, farm.incarnation, learner)))
        yield Run(learner, farm, broadcast, recording, tend.pool)


def _resumed(folder: RunFolder, config: RunConfig, *, mixed: bool) -> tuple[Problem, Checkpoint]:
    """The checkpoint to go on from, and what its run searches for.

    Raises:
      CheckpointError: it cannot be used, or belongs to another configuration.
    """
    at = checkpoints.load(folder.checkpoint)
    saved = configs.from_dict(at.config, str(folder.checkpoint))
    for name, old, new in configs.changes(saved, config):
        if name != "generations":
            raise CheckpointError(
                f"{folder.checkpoint} is of another configuration: --{name} is {old} there and {new} in config.json"
            )
    return resumed(config, at, folder.path, mixed=mixed), at


class _Tending:
    """Asked now and then whether to stop; looks after the local workers while at it."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped, self._next = stopped, 0.0
        self.pool: Pool | None = None

    def __call__(self) -> bool:
        if self.pool and time.monotonic() > self._next:
            self._next = time.monotonic() + _TEND
            if self.pool.tend() and not self.pool.pids:
                raise RunError("no local worker keeps running; their own messages above say why")
        return self._stopped()


def _check_alone(link: Session, place: Placement, run: str, stopped: Callable[[], bool]) -> None:
    """See that no other learner has a run of this name behind the same router: they would void each other's work.

    Raises:
      ConfigError: one has, and stays longer than a dead one would be remembered.
    """
    until = time.monotonic() + _REMEMBERED
    while place.connect and link.present(keys.learner_token(place.farm, run), 1.0):
        if time.monotonic() > until or stopped():
            raise ConfigError(f"a learner of run {run} is on farm {place.farm} already: take another --name")


def _session(place: Placement, stopped: Callable[[], bool]) -> AbstractContextManager[Session]:
    if place.connect:
        return session.connect(place.connect, None, stopped, place.tls)
    return session.listen(place.listen, place.farm, place.tls, trusted=place.trusted)


def _worker_flags(place: Placement, problem: Problem) -> list[str]:
    endpoints = place.connect or (place.listen,)
    farm = ["--farm", place.farm] if place.farm != "farm" else []
    files = [word for path in problem.files for word in ("--allow-file", str(path))]
    return [*(word for endpoint in endpoints for word in ("--connect", endpoint)), *farm, *files]


def how_to_join(place: Placement, problem: Problem) -> str:
    """The command by which workers join."""
    host = socket.gethostname()  # for an address that means all of them, other machines need the name
    flags = [
        flag.replace("/0.0.0.0:", f"/{host}:").replace("/[::]:", f"/{host}:") for flag in _worker_flags(place, problem)
    ]
    tls = ["--tls", "worker-NAME"] if place.tls else []
    return " ".join(["farm worker", *flags, *tls])


class _LogFile(logging.FileHandler):
    """Leaves out what cannot be written: a full disk is told of elsewhere."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's name
        """Say nothing."""


@contextmanager
def _log_file(folder: RunFolder) -> Iterator[None]:
    handler = _LogFile(folder.log, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        with suppress(OSError):
            handler.close()


@contextmanager
def _recording(place: Placement, learner: Learner) -> "Iterator[RunRecording]":
    from learner.recording.run import RunRecording

    problem = learner.problem
    recording = RunRecording(
        learner.folder.recording if place.record else None, replay=learner.folder.replay, run=learner.run,
        config=learner.config, spec=problem.spec, scene=problem.scene, camera=problem.task.camera,
        done=learner.state.generation, serve=place.serve,
    )  # fmt: skip
    try:
        yield recording
    finally:
        recording.finish()


def check_size(problem: Problem) -> None:
    """See that a mean fits into a message.

    Raises:
      ConfigError: it does not; says the largest size that does.
    """
    size, most = problem.policy.size, MESSAGE_LIMIT // 8
    if size > most:
        raise ConfigError(f"the policy has {size} parameters; at most {most} fit into a message")
    constants = sum(values.nbytes for values in problem.policy.constants.values())
    if constants > MESSAGE_LIMIT:
        raise ConfigError(
            f"the policy's constants take {constants >> 20} MiB; at most {MESSAGE_LIMIT >> 20} fit into a message"
        )


def check_rerun() -> None:
    """Whether rerun-sdk is there; it is an extra, workers do without.

    Raises:
      ConfigError: it is not; says what to install.
    """
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError("recording needs rerun-sdk: pip install 'rerun-sdk<0.42', or go without by --no-record")
