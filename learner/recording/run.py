"""A run's recording, made from its reports by a thread of its own, here or on another machine."""

import contextlib
import json
import logging
import queue
import shlex
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from farm import plugins
from farm.errors import ConfigError, writing
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report, RunEnd
from farm.sim.trajectory import Trajectory
from learner.recording.drawing import Drawing
from learner.recording.files import COMPACTING
from learner.recording.recorder import Recorder
from learner.run import config as configs
from learner.run.config import RunConfig

log = logging.getLogger(__name__)

WAITING: Final = 256
"""Length of the queue at which rollouts and traces are dropped."""

QUIET: Final = 0.5
"""How often the recorder looks, without new messages, whether to write what it holds back [s]."""

_CLOSE: Final = 60.0  # [s] for writing the queue at the end


class RunRecording(logging.Handler):
    """Records a run's reports and its end, and this process's log, in a separate thread.

    Learning never waits for it and never fails by it. If more than `waiting` messages are queued,
    rollouts and traces are dropped and counted, but never statistics and lines of the log. A
    recorder that fails (a full disk) ends the recording with one message in the log.
    """

    def __init__(
        self, recorder: Recorder, done: int = 0, replay: Path | None = None, waiting: int = WAITING
    ) -> None:
        """Start the thread.

        Args:
          recorder: what writes; from now on it belongs to the thread.
          done: generations that it has.
          replay: file for rollouts at physics rate, None for none.
          waiting: length of the queue.
        """
        super().__init__(logging.INFO)
        self._recorder, self._replay, self._waiting = recorder, replay, waiting
        self.uri = recorder.uri
        """Address for viewers; None without a server."""
        self.done = done
        """The last generation that is recorded or queued."""
        self.end: RunEnd | None = None
        """How the run ended, once it has."""
        self.failed = False
        """Whether the recording ended too early."""
        self.dropped = 0
        """Number of generations recorded without their rollout and traces, because the queue was
        full.
        """
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Record a message of this process's log."""
        self._line(record.levelname, record.getMessage())

    def put(self, message: Report | RunEnd) -> None:
        """Record a generation, or the end; a new best rollout at physics rate is written to the
        replay.
        """
        for line in message.lines:  # of the learner's log, if that is another process
            self._line(line.level, line.text)
        if isinstance(message, RunEnd):
            self._put_end(message)
            return
        self.done = message.generation
        best, stats = message.replay, message.progress
        if self._queue.qsize() >= self._waiting and (message.sample is not None or message.traces):
            message = replace(message, sample=None, traces={})
            self.dropped += 1
        self._call(partial(self._recorder.generation, message))
        if stats.return_max is not None and stats.return_max == stats.best:
            self._line("INFO", f"new best rollout: return {stats.best:.3f}")
        if best is not None:
            self._write_replay([(f"best rollout, generation {message.replay_generation}", best)])

    def settled(self) -> bool:
        """Wait until all that is queued is in the file; return false if the recording ended too
        early.
        """
        self._call(self._recorder.settle)
        return self.taken()

    def taken(self) -> bool:
        """Wait until the recorder has what is queued, which it may still hold back; return false if
        the recording ended too early.
        """
        reached = threading.Event()
        self._call(reached.set)
        while not (reached.wait(0.1) or self.failed):
            pass
        return not self.failed

    def finish(self, timeout: float | None = None) -> bool:
        """Record the queue, and close; an interrupted run's parts are merged when it continues.

        Args:
          timeout: for all this [s]; by default what it needs.

        Returns:
          whether everything is recorded.
        """
        logging.getLogger().removeHandler(self)
        self._queue.put(None)
        self._thread.join(
            _CLOSE + (COMPACTING if self.end else 0.0) if timeout is None else timeout
        )
        if self._thread.is_alive():
            log.warning("the recording is not complete in time: left as it is")
            return False
        return not self.failed

    def _put_end(self, end: RunEnd) -> None:
        self.end = end
        rollouts = (
            []
            if end.best is None
            else [(f"best rollout, generation {end.best_generation}", end.best)]
        )
        if end.mean is not None:
            value, generation = end.mean.returned, end.summary.get("policy_generation", self.done)
            result = {"generations": self.done, "return": value, "success": end.mean.success}
            self._call(partial(self._recorder.result, result))
            self._call(partial(self._recorder.final, end.mean, generation))
            rollouts.append((f"mean policy after generation {generation}", end.mean))
        if rollouts:
            self._write_replay(rollouts)

    def _write_replay(self, rollouts: Sequence[tuple[str, Trajectory]]) -> None:
        if self._replay is not None:
            self._call(partial(self._recorder.replay, self._replay, rollouts=rollouts))

    def _line(self, level: str, text: str) -> None:
        self._call(partial(self._recorder.log, text, level))

    def _call(self, call: Callable[[], None]) -> None:
        """Queue a call of one of the recorder's methods."""
        if not self.failed:
            self._queue.put(call)

    def _work(self) -> None:
        """Do what is queued, until the end. Thread: recorder."""
        try:
            while (call := self._next()) is not None:
                call()
            self._recorder.close(merge=self.end is not None)
        except Exception as error:
            self.failed = True
            log.error("the recording ends here, learning continues: %s", error)
            while not self._queue.empty():
                self._queue.get()
            with contextlib.suppress(Exception):  # save what is recorded as far as possible
                self._recorder.close(merge=self.end is not None)

    def _next(self) -> Callable[[], None] | None:
        """Return the next call.

        If there is none for a while, the one that writes what was held back long enough.
        """
        try:
            return self._queue.get(timeout=QUIET)
        except queue.Empty:
            return self._recorder.tend


@contextlib.contextmanager
def open_recording(
    path: Path | None,
    *,
    run: str,
    config: RunConfig,
    drawing: Drawing,
    done: int,
    serve: tuple[str, int] | None,
    folder: Path | None = None,
    ended: bool = False,
) -> Iterator[RunRecording]:
    """Open the file, with replay.rrd beside it, and the server, if requested; see `Recorder`.

    `folder` is the run's own, for commands in the recording's text; None if it is on another
    machine.

    Raises:
      ConfigError: the address is in use, or the file cannot be written.
    """
    ending = plugins.find("tasks", config.task).target.ending
    with writing(path, ConfigError):
        recorder = Recorder(
            path,
            run=run,
            drawing=drawing,
            config=markdown(config),
            serve=serve,
            done=done,
            ended=ended,
            properties=configs.properties(config),
            again=partial(again, shlex.quote(str(folder or "RUN")), ending),
        )
    recording = RunRecording(recorder, done, None if path is None else path.with_name("replay.rrd"))
    try:
        yield recording
    finally:
        recording.finish()


def markdown(config: RunConfig) -> str:
    """A configuration for display in the recording."""
    return f"```json\n{json.dumps(configs.to_dict(config), indent=2)}\n```"


def again(folder: str, ending: str, stats: GenerationStats) -> str:
    """The commands that show a generation again, Markdown; `ending` is the task's word for rollouts
    that it ended.

    The displayed rollout is of the mean policy after that generation.
    """
    replay = f"farm replay {folder} --generation"
    selections = [
        "--best 5",
        "--worst 5",
        *([f"--{ending} {min(5, stats.ended)}"] if stats.ended else []),
    ]
    side = "\n".join(f"{replay} {stats.generation} {which}" for which in selections)
    return (
        f"### Generation {stats.generation} again\n\nThe rollout in view, at physics"
        f" rate:\n\n```\n{replay} {stats.generation}\n```\n\nExploring rollouts, side by"
        f" side:\n\n```\n{side}\n```"
    )
