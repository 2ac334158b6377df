"""A run's recordings: the live one behind its thread, and the replays at physics rate."""

import json
import logging
from typing import Final

from farm.errors import ConfigError
from farm.scene import Scene
from farm.tasks.finger_gait import CONTROL_PERIOD
from farm.trajectory import Trajectory
from learner import config as configs
from learner.config import RunConfig
from learner.evaluation import Evaluation
from learner.learner import Learner, Report
from learner.recording.recorder import Recorder
from learner.recording.thread import RecorderThread

log = logging.getLogger(__name__)

_CLOSE: Final = 60.0  # [s] for what still waits to be written


class Recording(logging.Handler):
    """Takes reports and messages; whatever goes wrong here never reaches the learning."""

    def __init__(self, learner: Learner, scene: Scene, serve: tuple[str, int] | None, *, to_file: bool) -> None:
        """Open the file and, if wanted, the server.

        Raises:
          ConfigError: the address is taken, or the file cannot be written.
        """
        super().__init__(logging.INFO)
        self._learner = learner
        folder = learner.folder
        try:
            recorder = Recorder(
                folder.recording if to_file else None, run=learner.run, scene=scene, config=markdown(learner.config),
                horizon=learner.config.task.steps * CONTROL_PERIOD, serve=serve, done=learner.state.generation,
            )  # fmt: skip
        except OSError as error:
            raise ConfigError(f"cannot write {folder.recording}: {error.strerror}") from None
        self.uri = recorder.uri
        self._thread = RecorderThread(recorder)
        self._best: tuple[str, Trajectory] | None = None
        self._ended = False
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Show a message in the recording."""
        self._thread.log(record.getMessage(), record.levelname)

    def generation(self, report: Report) -> None:
        """Show a generation; the best rollout at physics rate goes into replay.rrd when there is a new one."""
        self._thread.generation(report.progress, report.sample, report.traces, report.rate)
        if report.replay is not None:
            self._best = (f"best rollout, generation {report.replay_generation}", report.replay)
            self._thread.replay(self._learner.folder.replay, [self._best])

    def end(self, evaluation: Evaluation) -> None:
        """Write replay.rrd once more: the best and the final rollout."""
        self._ended = True
        if evaluation.replay is not None:
            self._best = (f"best rollout, generation {self._learner.best_generation}", evaluation.replay)
        shown = [] if self._best is None else [self._best]
        if evaluation.mean.trajectory is not None:
            name = f"mean policy after generation {self._learner.state.generation}"
            shown.append((name, evaluation.mean.trajectory.trajectory()))
        self._thread.replay(self._learner.folder.replay, shown)

    def finish(self) -> None:
        """Write out what waits, and close; an interrupted run is in a hurry and merges when it goes on."""
        logging.getLogger().removeHandler(self)
        self._thread.close(_CLOSE, merge=self._ended)


def markdown(config: RunConfig) -> str:
    """A configuration as the recording shows it."""
    return f"```json\n{json.dumps(configs.to_dict(config), indent=2)}\n```"
