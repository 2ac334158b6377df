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
from learner.folder import RunFolder
from learner.learner import Evaluation, Learner, Report
from learner.recorder import Recorder, record_replay
from learner.recording_thread import RecorderThread

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
        self._learner, self._scene = learner, scene
        self._config = markdown(learner.config)
        folder = learner.folder
        try:
            recorder = Recorder(
                folder.recording if to_file else None, run=folder.name, scene=scene, config=self._config,
                horizon=learner.config.task.steps * CONTROL_PERIOD, serve=serve, done=learner.state.generation,
            )  # fmt: skip
        except OSError as error:
            raise ConfigError(f"cannot write {folder.recording}: {error.strerror}") from None
        self.uri = recorder.uri
        self._thread = RecorderThread(recorder)
        self._best: tuple[str, Trajectory] | None = None
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Show a message in the recording."""
        self._thread.log(record.getMessage(), record.levelname)

    def generation(self, report: Report) -> None:
        """Show a generation; keep the best rollout at physics rate."""
        self._thread.generation(report.progress, report.sample, report.traces, report.rate)
        if report.replay is not None:
            self._keep_best(report.replay, report.replay_generation)

    def end(self, evaluation: Evaluation) -> None:
        """Write the replays of the best and of the final rollout."""
        if evaluation.replay is not None:
            self._keep_best(evaluation.replay, self._learner.best_generation)
        final = evaluation.mean.trajectory
        if final is not None:
            name = f"mean policy after generation {self._learner.state.generation}"
            self._write([self._best, (name, final.trajectory())])

    def finish(self) -> None:
        """Write out what waits, and close."""
        logging.getLogger().removeHandler(self)
        self._thread.close(_CLOSE)

    def _keep_best(self, rollout: Trajectory, generation: int) -> None:
        self._best = (f"best rollout so far, generation {generation}", rollout)
        self._write([self._best])

    def _write(self, rollouts: list[tuple[str, Trajectory] | None]) -> None:
        folder: RunFolder = self._learner.folder
        try:
            shown = [rollout for rollout in rollouts if rollout is not None]
            record_replay(folder.replay, run=folder.name, scene=self._scene, config=self._config, rollouts=shown)
        except Exception as error:
            log.warning("no replay recorded: %s", error)


def markdown(config: RunConfig) -> str:
    """A configuration as the recording shows it."""
    return f"```json\n{json.dumps(configs.to_dict(config), indent=2)}\n```"
