"""A run's recordings: the live one behind its thread, and the replays at physics rate."""

import json
import logging
from pathlib import Path
from typing import Final

from farm import tasks
from farm.errors import ConfigError
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from learner import config as configs
from learner.config import RunConfig
from learner.recording.files import COMPACTING
from learner.recording.recorder import Recorder
from learner.recording.thread import RecorderThread
from learner.telemetry.report import Report

log = logging.getLogger(__name__)

_CLOSE: Final = 60.0  # [s] for what still waits to be written


class Recording(logging.Handler):
    """Takes reports and messages; whatever goes wrong here never reaches the learning."""

    def __init__(
        self,
        path: Path | None,
        *,
        replay: Path | None,
        run: str,
        config: RunConfig,
        scene: Scene,
        done: int,
        serve: tuple[str, int] | None,
    ) -> None:
        """Open the file and, if wanted, the server.

        Args:
          path: of the recording, None for none.
          replay: of the recording at physics rate, None for none.
          run: name that the run began with, the recording's id.
          config: the run's configuration.
          scene: what is drawn.
          done: generations that were recorded before.
          serve: host and port for viewers.

        Raises:
          ConfigError: the address is taken, or the file cannot be written.
        """
        super().__init__(logging.INFO)
        self._replay = replay
        sizes = tasks.sizes(config.task)
        try:
            recorder = Recorder(
                path, run=run, scene=scene, config=markdown(config),
                horizon=sizes.steps * sizes.period, serve=serve, done=done, properties=configs.properties(config),
            )  # fmt: skip
        except OSError as error:
            raise ConfigError(f"cannot write {path}: {error.strerror}") from None
        self.uri = recorder.uri
        self._thread = RecorderThread(recorder)
        self._best: tuple[str, Trajectory] | None = None
        self._ended = False
        logging.getLogger().addHandler(self)

    @property
    def dropped(self) -> int:
        """Generations recorded without their rollout and traces."""
        return self._thread.dropped

    def emit(self, record: logging.LogRecord) -> None:
        """Show a message in the recording."""
        self._thread.log(record.getMessage(), record.levelname)

    def generation(self, report: Report) -> None:
        """Show a generation; the best rollout at physics rate goes into replay.rrd when there is a new one."""
        self._thread.generation(report.progress, report.sample, report.traces, report.rate)
        if report.progress.return_max >= report.progress.best:
            self._thread.log(f"new best rollout: return {report.progress.best:.3f}")
        if report.replay is not None:
            self._best = (f"best rollout, generation {report.replay_generation}", report.replay)
            self._show([self._best])

    def end(self, generation: int, mean: Trajectory | None, best: Trajectory | None, best_generation: int) -> None:
        """The run is over: write replay.rrd once more.

        Args:
          generation: updates done.
          mean: the final mean policy's rollout.
          best: the best rollout, None where `generation` has shown it.
          best_generation: the generation it came from.
        """
        self._ended = True
        if best is not None:
            self._best = (f"best rollout, generation {best_generation}", best)
        shown = [] if self._best is None else [self._best]
        if mean is not None:
            self._thread.result({"generations": generation, "return": mean.value, "success": mean.success})
            shown.append((f"mean policy after generation {generation}", mean))
        if shown:
            self._show(shown)

    def line(self, level: str, text: str) -> None:
        """Show a message from elsewhere."""
        self._thread.log(text, level)

    def settled(self) -> bool:
        """Wait until everything so far is recorded; whether it is."""
        return self._thread.settled()

    def finish(self) -> None:
        """Write out what waits, and close; an interrupted run is in a hurry and merges when it goes on."""
        logging.getLogger().removeHandler(self)
        self._thread.close(_CLOSE + (COMPACTING if self._ended else 0.0), merge=self._ended)

    def _show(self, rollouts: list[tuple[str, Trajectory]]) -> None:
        if self._replay is not None:
            self._thread.replay(self._replay, rollouts)


def markdown(config: RunConfig) -> str:
    """A configuration as the recording shows it."""
    return f"```json\n{json.dumps(configs.to_dict(config), indent=2)}\n```"
