"""`farm play`: the learnt policy in MuJoCo's interactive viewer."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from farm import command_line
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import display
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError
from farm.settings import setting
from farm.sim.engines import DataEngine
from farm.sim.scene import Scene
from farm.sim.sim import Sim
from farm.targets import typed
from farm.tasks.base import TaskConfig
from farm.tasks.loop import Batch
from farm.tasks.standard import start
from learner.commands.of_run import OfRun
from learner.run.config import MOST_GENERATIONS
from learner.run.folder import RunFolder
from learner.tools.replay.command import config_of
from learner.tools.replay.loaded import LoadedPolicy, loaded


@dataclass(frozen=True, kw_only=True)
class PlayCommand(OfRun):
    """Plays the learnt policy repeatedly in MuJoCo's interactive viewer; Ctrl+drag pushes
    objects.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    generation: int | None = setting(None, least=0, most=MOST_GENERATIONS)
    """Generation whose mean policy is played, 0 for the first; by default the run's policy."""
    speed: float = setting(1.0, least=0.01, most=10)
    """Speed: 1 is real time."""
    hold: float = setting(2.0, least=0, most=3600)
    """Pause before the rollout is repeated [s]."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the task; the default is the run's own."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    config = config_of(words)
    default = PlayCommand(run=tyro.MISSING, task=config.task_config if config else TaskConfig())
    command = command_line.parse(PlayCommand, words, "farm play", default)
    folder = RunFolder.open(command.run, command.allow_file)
    policy = loaded(folder, command.generation, command.task, last=command.last)
    if not display():
        raise ConfigError(
            f"no display to open a window on: farm replay {typed(command.run)} --video rollout.gif"
            " draws without one"
        )
    from farm.sim.framing import View
    from farm.sim.viewer import watch

    logs.set_up("WARNING")
    say(
        f"mean policy after generation {policy.generation}; double-click a body, then push it by"
        " Ctrl and drag"
    )
    task = policy.problem.task
    view = View(Scene(task.model, *start(task)), task.camera)
    task.setup(Sim(DataEngine(task.model)))
    with stop_flag("ending") as stop:
        played = watch(
            copy.copy(task.model),
            rollout(policy),
            stop.wait,
            say,
            view=view,
            speed=command.speed,
            hold=command.hold,
        )
    say(f"{played} control steps played")
    return INTERRUPTED if stop.is_set() else 0


def rollout(policy: LoadedPolicy) -> Callable[[Sim], int]:
    """Show one nominal rollout; returns its number of control steps."""

    def play(sim: Sim) -> int:
        batch, acting = Batch(policy.problem.task, sim, [None]), policy.acting()
        while not batch.over and not sim.engine.over:  # type: ignore[attr-defined]  # a DataEngine
            batch.step(acting.act(batch.observe()))
        return sim.t

    return play
