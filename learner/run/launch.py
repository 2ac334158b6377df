"""A run from Python: learner, workers and recording in one call; what `farm run` does.

import farm

for report in farm.learn(farm.RunConfig(seed=3), "runs/first", workers=2):
    print(report.progress.mean_policy_return)
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from farm import plugins
from farm.commands.logs import Formatter
from farm.errors import ConfigError, RunError, check_addresses
from farm.net import keys
from farm.net.session import free_endpoint
from farm.net.telemetry import Report, RunEnd
from farm.processes import cores
from farm.sim.trajectory import Trajectory
from learner.algorithms import Diverged
from learner.loggers.base import Loggers
from learner.pool.admission import Admission
from learner.pool.connection import check_place, connected
from learner.pool.placement import Placement, check_workers
from learner.pool.pool import Pool, Stopped, open_pool
from learner.recording.files import check_rerun, set_aside
from learner.recording.stream import stream_port
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.evaluation import Evaluation
from learner.run.files import with_rates
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.run.pilot import begun, piloted
from learner.run.setup import Problem, fitted, handed_over, resumed, start
from learner.run.states import RolledBack
from learner.telemetry.publisher import Publisher

if TYPE_CHECKING:
    from learner.recording.run import RunRecording

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """What a run writes and shows beside its folder; does not affect its numbers."""

    record: bool = False
    """Write run.rrd and replay.rrd."""
    serve: tuple[str, int] | None = None
    """Stream live at this host and port."""
    log: tuple[str, ...] = ()
    """Loggers, by name."""
    compare: bool = True
    """Compare the result of a run that validates with doing nothing and a constant action."""

    def check(self) -> None:
        """Check, before anything is simulated, that what writes them is there.

        Raises:
          ConfigError: Rerun is not installed, the stream's port is in use, or there is no such
            logger.
        """
        if self.record or self.serve:
            check_rerun()
        if self.serve:
            stream_port(*self.serve)
        for name in self.log:
            plugins.find("loggers", name)


FOLDER_ONLY: Final = Outputs()
"""No recording, no stream, no logger."""


@dataclass
class Run:
    """A run that `open_run` opened: iterate over `learn`."""

    learner: Learner
    pool: Pool
    publisher: Publisher
    recording: "RunRecording | None"
    loggers: Loggers
    place: Placement
    outputs: Outputs
    summary: dict[str, Any] = field(default_factory=dict)
    """The contents of summary.json after the end."""
    _best: tuple[Trajectory | None, int] = (None, 0)

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the local workers."""
        return self.pool.worker_pids

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
            for report in self.learner.learn(self.pool):
                if report.replay is not None:
                    self._best = report.replay, report.replay_generation
                self.publisher.generation(report)
                if self.recording:
                    self.recording.put(report)
                self.loggers.generation(report.progress)
                yield report
            evaluation = self.learner.evaluate(self.pool, compare=self.outputs.compare)
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
        workers = max(len(self.pool.workers), len(self.worker_pids))
        self.summary = self.learner.summary(state, workers, evaluation)
        log.info(
            "%(state)s after %(generations)d generations, %(rollouts)d rollouts, %(seconds).0f s",
            self.summary,
        )
        if state == "finished" and (early := self.learner.early):
            log.info("it ended early: %s", early)
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
    configs.checked(config)
    check_workers(workers)
    loggers = (log,) if isinstance(log, str) else log
    if not isinstance(loggers, Sequence):
        raise ConfigError(f"log is {log!r:.60}; expected names of loggers")
    place = Placement(workers=workers, listen=free_endpoint())
    outputs = Outputs(record=record, log=tuple(loggers))
    with open_run(config, Path(folder), place, outputs) as run:
        yield from run.learn()


@contextmanager
def open_run(
    config: RunConfig,
    path: Path,
    place: Placement,
    outputs: Outputs = FOLDER_ONLY,
    *,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Run]:
    """Open all parts of a run, in an order that leaves nothing behind if one fails."""
    folder = RunFolder(path, configs.class_files(config))
    keys.checked("run", folder.name)
    check_addresses(2 << 30, "learning")
    outputs.check()
    check_place(place)
    with ExitStack() as stack:
        if resume:
            stack.enter_context(folder.held())
        config = begun(config, folder) if resume else _completed(config, folder, place, stopped)
        if resume:
            problem, at = _resumed(folder, config, place)
        else:
            problem, at = start(config, folder.name, fingerprint=place.fingerprint)
        if place.workers:
            problem.runner().close()  # reports early what no worker could simulate
        connection = stack.enter_context(
            connected(problem, place, stopped, claim=folder.name, fork=True)
        )
        if not resume:
            RunFolder.create(path, config)
            stack.enter_context(folder.held())
        try:
            if resume:
                folder.truncate(at)
                folder.write_config(config)
            learner = Learner(problem, folder, at)
            recording = _recording(outputs, learner, stack)
            stack.enter_context(_log_file(folder))
            loggers = Loggers(outputs.log, path, configs.to_dict(config), at.state["generation"])
            stack.callback(loggers.end, {})  # where nothing was learnt
        except (ConfigError, OSError) as error:
            if not resume:
                folder.discard()
            if isinstance(error, OSError):
                raise RunError(f"cannot write to {folder.path}: {error.strerror}") from None
            raise
        admission = Admission(learner.fingerprint, at.expelled, any_rounding=place.any_rounding)
        pool = stack.enter_context(
            open_pool(connection, problem, folder.name, admission, generations=config.generations)
        )
        publisher = stack.enter_context(
            closing(Publisher(connection.session, place.farm, pool.incarnation, learner))
        )
        yield Run(learner, pool, publisher, recording, loggers, place, outputs)


def _completed(
    config: RunConfig, folder: RunFolder, place: Placement, stopped: Callable[[], bool]
) -> RunConfig:
    """A new run's configuration with what is computed before it; says from what other task's run
    it begins.
    """
    folder.check_new()  # before a pilot takes its time
    if line := handed_over(config):
        log.info(line)
    processes = place.workers or cores()
    return piloted(fitted(config), stopped, processes=processes, awaited=not place.workers)


def _resumed(folder: RunFolder, config: RunConfig, place: Placement) -> tuple[Problem, Checkpoint]:
    """A saved run; the recording of what it has to undo is set aside."""
    problem, at = resumed(folder, config, place.fingerprint, any_rounding=place.any_rounding)
    if at.undone > checkpoints.load(folder.checkpoint).undone:
        set_aside(folder.recording)
    return problem, at


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


def _recording(outputs: Outputs, learner: Learner, stack: ExitStack) -> "RunRecording | None":
    if not (outputs.record or outputs.serve):
        return None
    from learner.recording.drawing import Drawing
    from learner.recording.files import last_generation
    from learner.recording.run import open_recording

    path, recorded = learner.folder.recording if outputs.record else None, 0
    # A recording that cannot be read stays as it is, and what follows is recorded beside it
    with suppress(ConfigError):
        recorded = 0 if path is None else last_generation(path)
    opened = stack.enter_context(
        open_recording(
            path,
            run=learner.run,
            config=learner.config,
            serve=outputs.serve,
            drawing=Drawing.of(learner.problem),
            done=learner.state.generation if recorded else 0,
            folder=learner.folder.path,
            ended=bool(recorded and learner.folder.ended),
        )
    )
    # The curves of what was not recorded, or was lost when the run was killed.
    for stats, rate in with_rates(learner.folder.progress_after(recorded - 1)):
        if stats.generation > recorded:
            opened.put(Report(progress=stats, rate=rate))
    return opened
