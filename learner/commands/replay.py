"""`farm replay`: any policy that a run stored again, at physics rate, into a recording and a video."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from farm import settings as arguments
from farm.commands.screen import draw_offscreen
from farm.errors import ConfigError, RunError
from learner.commands import recordings

if TYPE_CHECKING:
    from learner.replay import Again
    from learner.run_folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class ReplayCommand:
    """Any policy that a run stored again, at physics rate, into a recording."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path | None = None
    """Recording to write; None: gait.rrd in the run's folder."""
    generation: int | None = None
    """Generation whose mean policy is shown, 0 for the first; None: the last."""
    object: str | None = None
    """Another object to hold: the name of a file in assets/objects."""
    friction: float | None = None
    """Factor of every friction coefficient, of fingertips and object alike."""
    video: Path | None = None
    """Video to write as well: a name that ends in .gif or .mp4."""
    speed: float = 0.25
    """Speed of the video: 1 is real time."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.generation is not None and self.generation < 0:
            raise ConfigError(f"generation is {self.generation}; expected 0 or more")
        if not 0.01 <= self.speed <= 10:
            raise ConfigError(f"speed is {self.speed}; expected 0.01 to 10")


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ReplayCommand, words, "farm replay")
    draw_offscreen()
    from farm.sim import video
    from learner.replay import Conditions, again
    from learner.run import check_rerun
    from learner.run_folder import RunFolder

    check_rerun()
    if command.video is not None:
        video.check(command.video)
    conditions = Conditions(object=command.object, friction=command.friction)
    folder = RunFolder.open(command.run)
    if folder.read_config().task.kind != "finger-gait":
        return _environment(command, folder)
    path = recordings.target(command.to or folder.path / "gait.rrd")
    shown = again(folder, conditions, command.generation)
    _record(shown, folder, path, str(conditions))
    success = "the gait succeeds" if shown.trajectory.success else "the gait does not succeed"
    sys.stdout.write(f"return {shown.trajectory.value:.3f}, {success}\n")
    sys.stdout.write(f"written to {path}; look at it with: farm view {path}\n")
    if command.video is not None:
        _film(shown, command.video, command.speed)
        sys.stdout.write(f"video: {command.video}\n")
    return 0


def _environment(command: ReplayCommand, folder: "RunFolder") -> int:
    """The last policy of a run in an environment of Gymnasium, at control rate.

    Raises:
      ConfigError: an option that is for finger-gait was given.
    """
    from farm import tasks
    from learner.evaluation import evaluation_jobs
    from learner.recording.recorder import record_replay
    from learner.recording.run import markdown
    from learner.run import simulate

    config = folder.read_config()
    for name in ("generation", "object", "friction", "video"):
        if getattr(command, name) is not None:
            raise ConfigError(f"--{name} is for runs of finger-gait, and this one is of {config.task.task}")
    path = recordings.target(command.to or folder.path / "gait.rrd")
    generation, [result] = simulate(folder, evaluation_jobs(0, 0))
    if result.trajectory is None:
        raise RunError("the simulation gave no trajectory")
    rollout = (f"mean policy after generation {generation}", result.trajectory.trajectory())
    try:
        scene = tasks.scene(config.task)
        record_replay(path, run=folder.name, scene=scene, config=markdown(config), rollouts=[rollout])
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from None
    sys.stdout.write(f"return {result.returns[0]:.3f}\nwritten to {path}; look at it with: farm view {path}\n")
    return 0


def _record(shown: "Again", folder: "RunFolder", path: Path, conditions: str) -> None:
    from learner.recording.recorder import record_replay
    from learner.recording.run import markdown

    config, simulation = shown.stored.config, shown.stored.simulation
    name = ", ".join([f"mean policy after generation {shown.stored.generation}", *([conditions] if conditions else [])])
    try:
        record_replay(
            path, run=folder.name, scene=simulation.scene, config=markdown(config), rollouts=[(name, shown.trajectory)]
        )
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from None


def _film(shown: "Again", path: Path, speed: float) -> None:
    from farm.sim import rendering, video

    chosen = video.moments(shown.trajectory.times.tolist(), speed, rest=1.0)
    moments = sorted(set(chosen))
    held = shown.stored.simulation.scene.object_name
    drawn = dict(zip(moments, rendering.pictures(held, shown.frames.at(moments), video.SIZE), strict=True))
    video.write(path, [drawn[moment] for moment in chosen])
