"""`farm play`: the learnt policy in MuJoCo's interactive viewer."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import settings as arguments
from farm.commands import logs
from farm.commands.screen import display
from farm.commands.signals import stop_flag
from farm.errors import ConfigError
from learner.commands.learning import INTERRUPTED


@dataclass(frozen=True, kw_only=True)
class PlayCommand:
    """The learnt policy in MuJoCo's interactive viewer, over and over; Ctrl+drag pushes the object."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    generation: int | None = None
    """Generation whose mean policy is played, 0 for the first; None: the last."""
    object: str | None = None
    """Another object to hold: the name of a file in assets/objects."""
    speed: float = 1.0
    """1 is real time."""
    hold: float = 2.0
    """How long the hand rests before it begins again [s]."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.generation is not None and self.generation < 0:
            raise ConfigError(f"generation is {self.generation}; expected 0 or more")
        if not 0.01 <= self.speed <= 10:
            raise ConfigError(f"speed is {self.speed}; expected 0.01 to 10")
        if not 0 <= self.hold <= 3600:
            raise ConfigError(f"hold is {self.hold}; expected 0 to 3600")


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(PlayCommand, words, "farm play")
    from learner.replay import stored
    from learner.run_folder import RunFolder

    folder = RunFolder.open(command.run)
    policy = stored(folder, command.generation, command.object)
    if not display():
        raise ConfigError(
            f"no display to open a window on: farm replay {command.run} --video gait.gif draws without one"
        )
    from farm.sim.rendering import lit
    from farm.sim.viewer import Player, watch

    simulation = policy.simulation
    start = simulation.start
    scene = lit(simulation.scene.object_name)
    player = Player(scene, simulation.task, simulation.policy, policy.mu, start.rows[0], start.frames.at([0]))
    logs.set_up("WARNING")
    _say(f"mean policy after generation {policy.generation}; double-click the object, then push it by Ctrl and drag")
    with stop_flag("ending") as stop:
        played = watch(player, stop.wait, _say, speed=command.speed, hold=command.hold)
    _say(f"{played} control steps played")
    return INTERRUPTED if stop.is_set() else 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
