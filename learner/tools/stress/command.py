"""`farm stress`: the learnt policy under sensor errors, delays, weak motors, payloads, friction and
pushes.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import tyro

from farm import command_line
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import bar, compact, draw_offscreen, plain, wide
from farm.errors import ConfigError, writing
from farm.seeds import SEEDS
from farm.settings import setting
from farm.targets import check_target
from farm.tasks.base import Task
from learner import plots
from learner.commands.of_run import OfRun
from learner.run.evaluation import EVALUATION_ROLLOUTS, EVALUATION_SEED
from learner.run.folder import RunFolder
from learner.tools.stress import figure

if TYPE_CHECKING:
    from learner.tools.replay.loaded import LoadedPolicy
    from learner.tools.stress.stress import Stress

_STRENGTHS: Final = (0.0, 0.5, 1.0, 1.5, 2.0)
_MOST: Final = 8  # columns of 80 characters
_FILMS: Final = 4
_WIDTH: Final = 8


@dataclass(frozen=True, kw_only=True)
class StressCommand(OfRun):
    """Tries the learnt policy under conditions that differ, each cause alone and all together.

    The conditions are those that the task declares by farm.Robust, or sensible ones.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    rollouts: int = setting(EVALUATION_ROLLOUTS, least=1, most=1_000_000)
    """Number of rollouts for each cause and strength, from the same starts."""
    seed: int = setting(EVALUATION_SEED, least=0, most=SEEDS - 1)
    """Seed of the starts and of what is drawn; those of `farm evaluate` have the same."""
    strength: tuple[float, ...] = _STRENGTHS
    """Factor of each range's distance from none, repeatable."""
    body: str = ""
    """Body that is pushed and has the payload, if the task declares no conditions.

    By default the first that moves.
    """
    out: Path | None = None
    """Folder for stress.json and stress.svg; by default `stress` in the run's folder."""
    video: Path | None = None
    """Also write a video of the worst starts: a name that ends in .gif or .mp4."""
    speed: float = setting(1.0, least=0.01, most=10)
    """Speed of the video: 1 is real time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.strength) <= _MOST:
            raise ConfigError(
                f"--strength is given {len(self.strength)} times; expected at most {_MOST}"
            )
        for each in self.strength:
            if not 0.0 <= each <= 10.0:
                raise ConfigError(f"strength is {each:g}; expected 0 to 10")
        if list(self.strength) != sorted(set(self.strength)):
            raise ConfigError(
                f"strengths are {', '.join(f'{each:g}' for each in self.strength)}; expected rising"
                " ones"
            )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    command = command_line.parse(
        StressCommand, words, "farm stress", StressCommand(run=tyro.MISSING)
    )
    logs.set_up("WARNING")
    from farm.sim import video
    from learner.tools.replay.loaded import loaded
    from learner.tools.stress.stress import cells, sensible, stressed

    if command.video is not None:
        video.check(command.video)
    if command.out is not None:
        check_target("--out", command.out, folder=True)
    folder = RunFolder.open(command.run, command.allow_file)
    task = replace(folder.read_config().task_config, robust=1.0)
    policy = loaded(folder, task=task, last=command.last)
    robust = policy.problem.task.robust
    if robust is None:
        robust = sensible(policy, command.seed, command.body)
        pushed = f"; {robust.body!r} is pushed and loaded" if robust.body else ""
        say(f"the task declares no farm.Robust: these are sensible ranges{pushed}")
    elif command.body:
        raise ConfigError(
            f"--body {command.body}: the task declares its conditions, and their body"
        )
    with bar("rollouts", command.rollouts * cells(robust, command.strength)) as advance:
        stress = stressed(policy, robust, command.strength, command.rollouts, command.seed, advance)
    kind = type(policy.problem.task)
    _print(stress, policy, folder.name, kind)
    _write(stress, policy, command, folder, kind)
    if command.video is not None:
        _film(stress, policy, command)
    return 0


def measured(stress: "Stress", kind: type[Task]) -> tuple[str, str]:
    """Name of a cell's figure, and its words: success, else rollouts that ended early, else
    nothing.
    """
    cells = [cell for row in stress.cells.values() for cell in row]
    if cells[0]["success_rate"] is not None:
        return "success_rate", "success"
    if any(cell["ended"] for cell in cells):
        return "ended", kind.ending if kind.ending != Task.ending else "ended early"
    return "", ""


def share(cell: Mapping[str, Any], what: str) -> float:
    """Share of a cell's rollouts."""
    value: float = (
        cell["success_rate"] if what == "success_rate" else cell["ended"] / cell["rollouts"]
    )
    return value


def _print(stress: "Stress", policy: "LoadedPolicy", name: str, kind: type[Task]) -> None:
    what, word = measured(stress, kind)
    count = stress.cells[next(iter(stress.cells))][0]["rollouts"]
    say(f"{name}, policy of generation {policy.generation}, {count} starts in each cell")
    table = compact()
    table.add_column(plain("times its range"), no_wrap=True)
    for strength in stress.strengths:
        table.add_column(f"{strength:g}", justify="right", min_width=_WIDTH - 2, no_wrap=True)
    for cause, row in stress.cells.items():
        of_range = "" if cause not in stress.robust.causes else stress.robust.said(cause)
        returns = [_return(cell["return_mean"]) for cell in row]
        if what:
            table.add_row(
                plain(cause.replace("_", " ")), *(f"{share(cell, what):.0%}" for cell in row)
            )
            table.add_row(plain(f"  {of_range}"), *returns, style="dim")
        else:
            table.add_row(plain(f"{cause.replace('_', ' ')}  {of_range}"), *returns)
    wide(table).print(table)
    lines = f"{word}, and below it the mean return" if what else "the mean return"
    say(f"in each cell: {lines}")
    failed = sum(cell["failed"] for row in stress.cells.values() for cell in row)
    if failed:
        say(f"{failed} rollouts failed, unstable or by an error, and are in no mean return")


def _return(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e6 else f"{value:.3g}"


def _write(
    stress: "Stress",
    policy: "LoadedPolicy",
    command: StressCommand,
    folder: RunFolder,
    kind: type[Task],
) -> None:
    """Write the numbers, and a figure if matplotlib is installed."""
    out = command.out or folder.path / "stress"
    table = {
        "run": folder.name,
        "generation": policy.generation,
        "seed": command.seed,
        "rollouts": command.rollouts,
        **stress.to_dict(),
    }
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        (out / "stress.json").write_text(json.dumps(table, indent=2) + "\n", "utf-8")
        if not plots.available():
            say(f"written to {out}/stress.json; {plots.INSTALL}")
            return
        what, word = measured(stress, kind)
        curves = {
            cause.replace("_", " "): (
                [share(cell, what) for cell in row] if what else [],
                _returns(row),
            )
            for cause, row in stress.cells.items()
        }
        figure.draw(stress.strengths, curves, f"{word} (share)" if what else "", out / "stress.svg")
    say(f"written to {out}: stress.json, stress.svg")


def _returns(row: Sequence[Mapping[str, Any]]) -> list[float]:
    return [float("nan") if cell["return_mean"] is None else cell["return_mean"] for cell in row]


def _film(stress: "Stress", policy: "LoadedPolicy", command: StressCommand) -> None:
    """Film the worst starts with all causes together."""
    from learner.commands import recordings
    from learner.tools.stress.stress import again

    assert command.video is not None
    indices = stress.worst[:_FILMS]
    replays = again(policy, stress, indices, command.rollouts, command.seed)
    for index, each in zip(indices, replays, strict=True):
        say(f"start {index}: {each.trajectory.verdict}")
    films = [
        (f"start {index}, all causes", each.trajectory, each.frames)
        for index, each in zip(indices, replays, strict=True)
    ]
    recordings.film(policy.problem.task, films, command.video, command.speed)
