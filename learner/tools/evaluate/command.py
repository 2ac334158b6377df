"""`farm evaluate`: the learnt mean policy on perturbed starts."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from farm import settings
from farm.arrays import IntArray
from farm.commands.logs import say
from farm.commands.screen import compact, figure, plain
from farm.net.work import Simulated
from farm.seeds import SEEDS, trial
from farm.settings import setting
from farm.sim.mixed import names
from farm.tasks.base import TaskSpec
from farm.tasks.rollouts import drawn
from learner.commands.of_run import OfRun
from learner.run.config import MOST_GENERATIONS
from learner.run.evaluation import (
    EVALUATION_ROLLOUTS,
    EVALUATION_SEED,
    evaluation_jobs,
    failures,
    statistics,
)
from learner.run.folder import RunFolder
from learner.tools.replay.loaded import loaded

_LABEL: Final = 24  # characters of a name before it is folded
_GAP: Final = 2  # between columns


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(OfRun):
    """Tests the learnt policy on perturbed starts and conditions drawn by its task."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    rollouts: int = setting(EVALUATION_ROLLOUTS, least=1, most=1_000_000)
    """Number of perturbed rollouts."""
    seed: int = setting(EVALUATION_SEED, least=0, most=SEEDS - 1)
    """Seed of the perturbations."""
    average: int | None = setting(None, least=1, most=MOST_GENERATIONS)
    """Average the means after this number of last generations; by default the run's own policy."""
    json: bool = False
    """Print JSON instead of a table."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = settings.parse(EvaluateCommand, words, "farm evaluate")
    folder = RunFolder.open(command.run, command.allow_file)
    figures = evaluate(folder, command.rollouts, command.seed, command.average, last=command.last)
    if command.json:
        say(json.dumps(figures, indent=2))
        return 0
    console = Console()
    console.print(
        plain(f"{folder.name}, mean policy after generation {figures['generation']}"),
        soft_wrap=True,
    )
    for table in tables(figures, console.width):
        console.print(table)
    if command.seed == EVALUATION_SEED and command.average is None:
        which = f"{command.run}{' --last' if command.last else ''}"
        say(f"the worst start: farm replay {which} --seed {figures['perturbed']['worst_start']}")
    if figures["nominal"]["failed"]:
        say(
            "it fails from its nominal start, unstable or by an error: farm check looks for the"
            " cause"
        )
    elif failed := figures["perturbed"]["failed"]:
        say(
            f"{failed} of {command.rollouts} rollouts failed, unstable or by an error, and are in"
            " no mean: farm check looks for the cause"
        )
    return 0


def tables(figures: Mapping[str, Any], width: int) -> Iterator[Table]:
    """The figures, a column for each kind of conditions, as many tables as they need.

    Args:
      figures: as `evaluate` gives them.
      width: of the screen [characters], in which no number is cut.
    """
    rows = {name: figures[name] for name in ("nominal", "perturbed")} | figures.get("models", {})
    columns = [(name, _column(row)) for name, row in rows.items()]
    left = min(_LABEL, max(map(len, columns[0][1])))
    while columns:
        table = compact()
        table.add_column(max_width=_LABEL, overflow="fold")
        room = width - left - _GAP
        shown = list[list[str]]()
        while columns:
            name, cells = columns[0]
            number = max(map(len, cells.values()))
            wide = max(number, min(len(name), _LABEL))
            if shown and wide > room:
                break
            table.add_column(
                plain(name), justify="right", min_width=number, max_width=wide, overflow="fold"
            )
            shown.append(list(cells.values()))
            room -= wide + _GAP
            columns.pop(0)
        for label, *numbers in zip(cells, *shown, strict=True):
            table.add_row(plain(label), *numbers)
        yield table


def _column(row: Mapping[str, Any]) -> dict[str, str]:
    """Figures of some rollouts as texts, by what they are."""
    success = "-" if row["success_rate"] is None else f"{row['success_rate']:.0%}"
    return {
        "rollouts": str(row["rollouts"]),
        "failed": str(row["failed"]),
        "ended early": str(row["ended"]),
        "success": success,
        "return": figure(row["return_mean"]),
        "  lowest": figure(row["return_min"]),
        "  highest": figure(row["return_max"]),
        **{name: figure(value, ".3g") for name, value in row.get("measures", {}).items()},
    }


def evaluate(
    folder: RunFolder, rollouts: int, seed: int, average: int | None = None, *, last: bool = False
) -> dict[str, Any]:
    """The figures in the JSON's form."""
    policy = loaded(folder, average=average, last=last)
    spec = policy.problem.spec
    results = policy.runner.run(policy.mu, evaluation_jobs(rollouts, seed))
    figures: dict[str, Any] = {"run": folder.name, "generation": policy.generation, "seed": seed}
    figures["nominal"] = _figures(spec, results, np.array([rollouts]))
    figures["perturbed"] = _figures(spec, results, np.arange(rollouts))
    figures["perturbed"]["worst_start"] = int(np.argmin(results.returns[:rollouts]))
    task = policy.problem.task
    if len(task.simulated) > 1:
        which = drawn(task, [np.random.default_rng(trial(seed, i)) for i in range(rollouts)])
        rows = {name: np.flatnonzero(which == i) for i, name in enumerate(names(task.simulated))}
        figures["models"] = {
            name: _figures(spec, results, part) for name, part in rows.items() if len(part)
        }
    return figures


def _figures(spec: TaskSpec, results: Simulated, rows: IntArray) -> dict[str, Any]:
    """Figures of some rollouts, at least one."""
    returns, flags = results.returns[rows], results.flags[rows]
    return {
        "rollouts": len(returns),
        "success_rate": float(flags[:, 0].mean()) if spec.success else None,
        **statistics(returns),
        **({"measures": _measures(spec, results, rows)} if spec.measures else {}),
        "ended": int(flags[:, 1].sum()),
        "failed": failures(flags),
    }


def _measures(spec: TaskSpec, results: Simulated, rows: IntArray) -> dict[str, float | None]:
    """Means of the task's measures over rollouts that did not fail, by name."""
    sound = ~results.flags[rows, 2]
    values = results.measures[rows][sound]
    return {
        each.name: float(values[:, at].mean()) if sound.any() else None
        for at, each in enumerate(spec.measures)
    }
