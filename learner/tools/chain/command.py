"""`farm chain`: runs learnt policies in turn, each from where the previous one ended."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from rich.table import Table

from farm import command_line, seeds
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import Console, draw_offscreen
from farm.errors import ConfigError
from farm.seeds import SEEDS
from farm.settings import setting
from farm.targets import typed
from learner.commands import recordings
from learner.commands.of_run import OfRun
from learner.run.folder import RunFolder

if TYPE_CHECKING:
    from learner.tools.chain.chain import Chained
    from learner.tools.replay.loaded import LoadedPolicy


@dataclass(frozen=True, kw_only=True)
class ChainCommand(OfRun):
    """Runs learnt policies in turn, each from where the previous one ended, and counts their
    cycles.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs, in the order in which their policies act."""
    starts: int = setting(50, least=1, most=100_000)
    """Perturbed starts."""
    steps: int = setting(1000, least=1, most=100_000)
    """Largest number of control steps of a chain."""
    seed: int = setting(0, least=0, most=SEEDS - 1)
    """Seed of the perturbations."""
    to: Path = Path("chain.rrd")
    """Recording to write; an existing file is replaced."""
    shown: int = setting(120, least=1, most=10_000)
    """Control steps of the unperturbed chain that is recorded."""
    video: Path | None = None
    """Also write a video of it: a name that ends in .gif or .mp4."""
    speed: float = setting(1.0, least=0.01, most=10)
    """Speed of the video: 1 is real time."""
    json: bool = False
    """Print JSON instead of a table, and record nothing."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    command = command_line.parse(ChainCommand, words, "farm chain")
    from farm.sim import video
    from learner.tools.chain.chain import chain, check
    from learner.tools.replay.loaded import loaded

    logs.set_up("WARNING")
    policies = [
        loaded(RunFolder.open(path, command.allow_file), last=command.last) for path in command.runs
    ]
    check(policies)
    check_lengths(policies, command)
    if command.video is not None:
        video.check(command.video)
    starts = [seeds.evaluation_start(command.seed, i) for i in range(command.starts)]
    if command.json:
        say(json.dumps(figures(chain(policies, starts, command.steps), len(policies)), indent=2))
        return 0
    from learner.recording.files import check_rerun

    check_rerun()
    recordings.target(command.to)
    results = figures(chain(policies, starts, command.steps), len(policies))
    table = Table(title=f"{len(policies)} policies in turn, {command.starts} perturbed starts")
    table.add_column("cycles, at least")
    table.add_column("starts", justify="right")
    for cycles, part in results["cycles_at_least"].items():
        table.add_row(cycles, f"{part:.0%}")
    Console().print(table)
    changes = (
        f"changes: median {results['changes_median']:g}, {results['changes_min']} to"
        f" {results['changes_max']}"
    )
    say(
        f"{changes}; {results['lost']} of {command.starts} lost within {command.steps} control"
        " steps"
    )
    _record(policies, command)
    return 0


def check_lengths(policies: "Sequence[LoadedPolicy]", command: ChainCommand) -> None:
    """Check that the tasks have equal control steps, before any work is done: a ConfigError names
    the flag.
    """
    for flag in ("steps", "shown"):
        for policy in policies:
            try:
                replace(policy.problem.task.config, steps=getattr(command, flag))
            except ConfigError as error:
                raise ConfigError(f"--{flag}: {error}") from None


def figures(chained: "Chained", policies: int) -> dict[str, Any]:
    """The results in the JSON's form."""
    changes, cycles = chained.changes, chained.changes // policies
    return {
        "starts": len(changes),
        "steps": chained.task.steps,
        "changes_median": float(np.median(changes)),
        "changes_min": int(changes.min()),
        "changes_max": int(changes.max()),
        "lost": int((chained.rollouts.ended | chained.rollouts.failed).sum()),
        "cycles_at_least": {
            str(least): float((cycles >= least).mean()) for least in (1, 5, 10, 25)
        },
    }


def _record(policies: "Sequence[LoadedPolicy]", command: ChainCommand) -> None:
    """The unperturbed chain, at physics rate."""
    from farm.tasks.rollouts import trajectory, whole
    from learner.tools.chain.chain import chain

    first = policies[0].problem
    chained = chain(policies, [None], command.shown, every=1)
    rollout = trajectory(chained.task, first.spec, first.scene, chained.rollouts, 0)
    # Its reward would be the first policy's throughout.
    rollout = replace(rollout, terms=np.zeros_like(rollout.terms), value=float("nan"), success=None)
    name = f"{len(policies)} policies in turn: the goal is reached {chained.changes[0]} times"
    recordings.record(command.to, "chain", first, name, rollout)
    say(f"written to {command.to}; look at it with: farm view {typed(command.to)}")
    if command.video is not None:
        frames = whole(chained.rollouts, 0)
        recordings.film(chained.task, [(name, rollout, frames)], command.video, command.speed)
