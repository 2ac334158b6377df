"""`farm evaluate`: the learnt mean policy on perturbed starts."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro
from rich.table import Table

from farm import command_line
from farm.commands.logs import say
from farm.commands.screen import Console, bar, compact, figure, plain
from farm.targets import typed
from learner.commands.of_run import OfRun
from learner.run.evaluation import EVALUATION_SEED
from learner.tools.evaluate.evaluate import Perturbed, evaluate

_LABEL: Final = 24  # characters of a name before it is folded
_GAP: Final = 2  # between columns


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(OfRun, Perturbed):
    """Tests the learnt policy on perturbed starts and conditions drawn by its task."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    json: bool = False
    """Print JSON instead of a table."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(EvaluateCommand, words, "farm evaluate")
    with bar("rollouts", command.rollouts + 1) as advance:  # one is from the nominal start
        figures = evaluate(
            command.run,
            rollouts=command.rollouts,
            seed=command.seed,
            average=command.average,
            last=command.last,
            allow_file=command.allow_file,
            advance=advance,
        )
    if command.json:
        say(json.dumps(figures, indent=2))
        return 0
    console = Console()
    console.print(
        plain(f"{figures['run']}, mean policy after generation {figures['generation']}"),
        soft_wrap=True,
    )
    for table in tables(figures, console.width):
        console.print(table)
    if command.seed == EVALUATION_SEED and command.average is None:
        which = f"{typed(command.run)}{' --last' if command.last else ''}"
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
      figures: as `farm.evaluate` gives them.
      width: of the screen [characters], in which no number is cut.
    """
    rows = {name: figures[name] for name in ("nominal", "perturbed")} | figures.get("models", {})
    columns = [(name, _column(row)) for name, row in rows.items()]
    if all(row["success_rate"] is None for row in rows.values()):  # the task knows no success
        for _, texts in columns:
            del texts["success"]
    left = min(_LABEL, max(map(len, columns[0][1])))
    while columns:
        table = compact()
        table.add_column(max_width=_LABEL, overflow="fold")
        room = width - left - _GAP
        column_cells = list[list[str]]()
        while columns:
            name, cells = columns[0]
            number = max(map(len, cells.values()))
            wide = max(number, min(len(name), _LABEL))
            if column_cells and wide > room:
                break
            table.add_column(
                plain(name), justify="right", min_width=number, max_width=wide, overflow="fold"
            )
            column_cells.append(list(cells.values()))
            room -= wide + _GAP
            columns.pop(0)
        for label, *numbers in zip(cells, *column_cells, strict=True):
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
