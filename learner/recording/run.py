"""A run's recordings: the live one, written by a separate thread, and the replays at physics rate."""

import contextlib
import json
import logging
import queue
import shlex
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from farm import plugins
from farm.arrays import AnyArray
from farm.errors import ConfigError, writing
from farm.net.stats import GenerationStats
from farm.sim.trajectory import Trajectory
from learner import config as configs
from learner.config import RunConfig
from learner.recording.drawing import Drawing
from learner.recording.files import COMPACTING
from learner.recording.recorder import Recorder
from learner.telemetry.report import Report

log = logging.getLogger(__name__)

WAITING: Final = 256
"""Length of the queue at which rollouts and traces are dropped."""

QUIET: Final = 0.5
"""Rollouts that are held back are written after this time without a new one [s]."""

_CLOSE: Final = 60.0  # [s] for writing the queue at the end


class RecorderThread:
    """Calls a recorder in a separate thread: learning never waits for it and never fails because of it.

    If more than `waiting` messages are queued, rollouts and traces are dropped and counted, but never statistics and
    log messages. A recorder that fails (a full disk) ends the recording with one message in the log.
    """

    def __init__(self, recorder: Recorder, waiting: int = WAITING) -> None:
        self._recorder, self._waiting = recorder, waiting
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self.failed = False
        """Whether the recording ended too early."""
        self._merge = True
        self.dropped = 0
        """Number of generations recorded without their rollout and traces, because the queue was full."""
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    def put(self, call: Callable[[], None]) -> None:
        """Queue a call of one of the recorder's methods."""
        if not self.failed:
            self._queue.put(call)

    def generation(
        self, stats: GenerationStats, sample: Trajectory | None, traces: Mapping[str, AnyArray], rate: float
    ) -> None:
        """Queue a generation; see `Recorder.generation`."""
        if self._queue.qsize() >= self._waiting and (sample is not None or traces):
            sample, traces = None, {}
            self.dropped += 1
        self.put(lambda: self._recorder.generation(stats, sample, traces, rate))

    def settled(self) -> bool:
        """Wait until the queue is recorded; return false if the recording ended too early."""
        reached = threading.Event()
        self.put(self._recorder.settle)
        self.put(reached.set)
        while not (reached.wait(0.1) or self.failed):
            pass
        return not self.failed

    def close(self, timeout: float | None = None, *, merge: bool = True) -> bool:
        """Record the queue within a timeout [s], compact the file if requested; return whether all is recorded."""
        self._merge = merge
        self._queue.put(None)
        self._thread.join(timeout)
        if self._thread.is_alive():
            log.warning("the recording is not complete after %g s: left as it is", timeout)
            return False
        return not self.failed

    def _work(self) -> None:
        try:
            while (call := self._next()) is not None:
                call()
            self._recorder.close(merge=self._merge)
        except Exception as error:
            self.failed = True
            log.error("the recording ends here, learning continues: %s", error)
            while not self._queue.empty():
                self._queue.get()
            with contextlib.suppress(Exception):  # save what is recorded as far as possible
                self._recorder.close(merge=self._merge)

    def _next(self) -> Callable[[], None] | None:
        """Return the next call; if there is none for a while, the one that writes held back rollouts."""
        try:
            return self._queue.get(timeout=QUIET)
        except queue.Empty:
            return self._recorder.settle


class RunRecording(logging.Handler):
    """A run's recordings, from its reports and log messages; errors here never affect learning."""

    def __init__(
        self,
        path: Path | None,
        *,
        replay: Path | None,
        run: str,
        config: RunConfig,
        drawing: Drawing,
        done: int,
        serve: tuple[str, int] | None,
        folder: Path | None = None,
    ) -> None:
        """Open the file and, if requested, the server; see `Recorder`. `replay` is the recording at physics rate.

        `folder` is the run's own, for commands in the recording's text; None if it is on another machine.

        Raises:
          ConfigError: the address is in use, or the file cannot be written.
        """
        super().__init__(logging.INFO)
        self._replay, ending = replay, plugins.find("tasks", config.task).target.ending
        with writing(path, ConfigError):
            self._recorder = Recorder(
                path, run=run, drawing=drawing, config=markdown(config), serve=serve, done=done,
                properties=configs.properties(config),
                again=partial(again, shlex.quote(str(folder or "RUN")), ending),
            )  # fmt: skip
        self.uri = self._recorder.uri
        self.thread = RecorderThread(self._recorder)
        self._best: tuple[str, Trajectory] | None = None
        self._ended = False
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Record a message of the log."""
        self.line(record.levelname, record.getMessage())

    def line(self, level: str, text: str) -> None:
        """Record a log message; levels are those of the standard library."""
        self.thread.put(lambda: self._recorder.log(text, level))

    def generation(self, report: Report) -> None:
        """Record a generation; a new best rollout at physics rate is written to replay.rrd."""
        self.thread.generation(report.progress, report.sample, report.traces, report.rate)
        if report.progress.return_max >= report.progress.best:
            self.line("INFO", f"new best rollout: return {report.progress.best:.3f}")
        if report.replay is not None:
            self._best = (f"best rollout, generation {report.replay_generation}", report.replay)
            self._write_replay([self._best])

    def end(self, generation: int, mean: Trajectory | None, best: Trajectory | None, best_generation: int) -> None:
        """Record a run's end after this number of updates, and write replay.rrd again; `best` is None if already there.

        The rollouts are those of the final mean policy, and the best one with its generation.
        """
        self._ended = True
        if best is not None:
            self._best = (f"best rollout, generation {best_generation}", best)
        rollouts = [] if self._best is None else [self._best]
        if mean is not None:
            result = {"generations": generation, "return": mean.value, "success": mean.success}
            self.thread.put(lambda: self._recorder.result(result))
            self.thread.put(lambda: self._recorder.final(mean))
            rollouts.append((f"mean policy after generation {generation}", mean))
        if rollouts:
            self._write_replay(rollouts)

    def finish(self) -> None:
        """Write the queue, and close; an interrupted run's parts are merged when it continues."""
        logging.getLogger().removeHandler(self)
        self.thread.close(_CLOSE + (COMPACTING if self._ended else 0.0), merge=self._ended)

    def _write_replay(self, rollouts: Sequence[tuple[str, Trajectory]]) -> None:
        path = self._replay
        if path is not None:
            self.thread.put(lambda: self._recorder.replay(path, rollouts=rollouts))


def markdown(config: RunConfig) -> str:
    """A configuration for display in the recording."""
    return f"```json\n{json.dumps(configs.to_dict(config), indent=2)}\n```"


def again(folder: str, ending: str, stats: GenerationStats) -> str:
    """The commands that show a generation again, Markdown; `ending` is the task's word for rollouts that it ended.

    The displayed rollout is of the mean policy after that generation.
    """
    replay = f"farm replay {folder} --generation"
    chosen = ["--best 5", "--worst 5", *([f"--{ending} {min(5, stats.ended)}"] if stats.ended else [])]
    side = "\n".join(f"{replay} {stats.generation} {which}" for which in chosen)
    return (
        f"### Generation {stats.generation} again\n\nThe rollout in view, at physics rate:\n\n"
        f"```\n{replay} {stats.generation}\n```\n\nExploring rollouts, side by side:\n\n```\n{side}\n```"
    )
