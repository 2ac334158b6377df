"""`farm replay`: any policy that a run stored again, at physics rate, into a recording and a video."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from farm import settings
from farm.commands.logs import say
from farm.commands.screen import draw_offscreen
from farm.errors import writing
from farm.settings import Settings, setting
from farm.tasks.base import TaskConfig
from learner.commands import recordings
from learner.run_folder import RunFolder

if TYPE_CHECKING:
    from learner.replay import LoadedPolicy, Replay


@dataclass(frozen=True, kw_only=True)
class ReplayCommand(Settings):
    """Any policy of a run again, at physics rate, into a recording; its task may have other settings."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: Path | None = None
    """Recording to write; None: rollout.rrd in the run's folder."""
    generation: int | None = setting(None, least=0)
    """Generation whose mean policy is shown, 0 for the first; None: the last."""
    video: Path | None = None
    """Video to write as well: a name that ends in .gif or .mp4."""
    speed: float = setting(0.25, least=0.01, most=10)
    """Speed of the video: 1 is real time."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the task, the run's own unless given."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    own = task_of(words)
    default = ReplayCommand(run=tyro.MISSING, task=own or TaskConfig())
    command = settings.parse(ReplayCommand, words, "farm replay", default)
    from farm.sim import video
    from learner.replay import loaded
    from learner.run import check_rerun

    check_rerun()
    from learner.recording.drawing import Drawing
    from learner.recording.replay import record_replay
    from learner.recording.run import markdown

    if command.video is not None:
        video.check(command.video)
    folder = RunFolder.open(command.run)
    path = recordings.target(command.to or folder.path / "rollout.rrd")
    policy = loaded(folder, command.generation, command.task)
    shown = policy.rollout()
    changed = differing(own or command.task, command.task)
    name = f"mean policy after generation {policy.generation}" + (f", {changed}" if changed else "")
    with writing(path):
        record_replay(
            path, run=folder.name, drawing=Drawing.of(policy.problem), config=markdown(policy.problem.config),
            rollouts=[(name, shown.trajectory)],
        )  # fmt: skip
    success = {True: ", it succeeds", False: ", it does not succeed", None: ""}[shown.trajectory.success]
    say(f"return {shown.trajectory.value:.3f}{success}", f"written to {path}; look at it with: farm view {path}")
    if command.video is not None:
        _film(policy, shown, command.video, command.speed)
        say(f"video: {command.video}")
    return 0


def task_of(words: Sequence[str]) -> TaskConfig | None:
    """The task's settings of the run that the words name, so that its flags are known; None where they name none."""
    for word in words:
        if not word.startswith("-") and (Path(word) / "config.json").is_file():
            return RunFolder(Path(word)).read_config().task_config
    return None


def differing(own: TaskConfig, chosen: TaskConfig) -> str:
    """Settings that were changed, as a caption says them."""
    names = [f.name for f in fields(own) if getattr(own, f.name) != getattr(chosen, f.name)]
    return ", ".join(f"{name.replace('_', ' ')} {getattr(chosen, name)}" for name in names)


def _film(policy: "LoadedPolicy", shown: "Replay", path: Path, speed: float) -> None:
    from farm.sim import rendering, video

    chosen = video.moments(shown.trajectory.times.tolist(), speed, rest=1.0)
    moments = sorted(set(chosen))
    task, values = policy.problem.task, shown.trajectory.channels
    pictures = rendering.pictures(
        task.model, shown.frames["qpos"][moments], video.SIZE, camera=task.camera, channels=task.channels,
        values={name: each[moments] for name, each in values.items()},
    )  # fmt: skip
    drawn = dict(zip(moments, pictures, strict=True))
    video.write(path, [drawn[moment] for moment in chosen])
