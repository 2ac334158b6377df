"""Results of a sweep's runs: one row per run, means over the seeds, and curves."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import writing
from learner import parquet
from learner.run.files import replace_text
from learner.run.folder import RunFolder
from learner.tools.sweep.grid import Sweep

COLUMNS: Final = {
    "seed": "int",
    "state": "text",
    "generations": "int",
    "rollouts": "int",
    "first_mean_policy_return": "number",
    "mean_policy_return": "number",
    "mean_policy_success": "truth",
    "robust_success_rate": "number",
    "robust_return": "number",
    "robust_failed": "int",
    "seconds": "number",
    "parameters_sha256": "text",
}
"""Columns of the table after the varied settings (text as given), and their types: fields of
summary.json, and the return of the mean policy before learning.
"""

MEASURE: Final = "measure_"
"""Before the name of a task's measure in a column: its mean over the perturbed starts of the
evaluation.
"""


def column(name: str) -> str:
    """The column of a setting that is varied: its name, unless a result is called so."""
    return f"setting_{name}" if name in COLUMNS else name


def rows(sweep: Sweep) -> list[dict[str, Any]]:
    """One row per run, setting by setting; unknown values are None."""
    return [
        {column(name): value for name, value in setting.values.items()}
        | _row(sweep.folder(i, seed), seed)
        for i, setting in enumerate(sweep.settings)
        for seed in sweep.seeds
    ]


def _row(path: Path, seed: int) -> dict[str, Any]:
    folder = RunFolder(path)
    summary, progress = folder.read_summary() or {}, folder.progress()
    row: dict[str, Any] = {name: summary.get(name) for name in COLUMNS} | {"seed": seed}
    values = summary.get("robust_measures") or summary.get("mean_policy_measures") or {}
    row |= {f"{MEASURE}{name}": values[name] for name in values}
    if progress:
        last = progress[-1]
        row |= {"generations": last.generation, "rollouts": last.rollouts, "seconds": last.seconds}
        row["first_mean_policy_return"] = progress[0].mean_policy_return
    row["state"] = summary.get("state") or ("unfinished" if progress else "not begun")
    return row


def measures(table: Sequence[dict[str, Any]]) -> list[str]:
    """Columns of the task's measures, in their order."""
    return list(dict.fromkeys(name for row in table for name in row if name.startswith(MEASURE)))


def write_csv(path: Path, sweep: Sweep, table: Sequence[dict[str, Any]]) -> None:
    """Write table.csv atomically; raises RunError if it cannot be written."""
    text = io.StringIO()
    names = [*map(column, sweep.vary), *COLUMNS, *measures(table)]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    with writing(path):
        replace_text(path, text.getvalue())


def write_parquet(path: Path, sweep: Sweep, table: Sequence[dict[str, Any]]) -> None:
    """Write table.parquet, with types, atomically; raises RunError if it cannot be written."""
    settings = {column(name): "text" for name in sweep.vary}
    columns = settings | COLUMNS | dict.fromkeys(measures(table), "number")
    parquet.write(
        path, {name: (kind, [row.get(name) for row in table]) for name, kind in columns.items()}
    )


def spread(table: Sequence[dict[str, Any]], column: str) -> tuple[float, float] | None:
    """Mean and standard deviation of a column over the runs that have a value; None if none has."""
    values = [float(row[column]) for row in table if row.get(column) is not None]
    return (float(np.mean(values)), float(np.std(values))) if values else None


@dataclass(frozen=True)
class Curve:
    """The mean policy's return over rollouts, of a setting's runs."""

    label: str
    rollouts: FloatArray
    """Exploring rollouts before this policy, (G,)"""
    returns: FloatArray
    """(runs, G); nan after a run's end and where the mean policy failed"""


def curves(sweep: Sweep) -> list[Curve]:
    """One curve per setting that has a started run."""
    out = (
        curve(setting.label, [sweep.folder(i, seed) for seed in sweep.seeds])
        for i, setting in enumerate(sweep.settings)
    )
    return [each for each in out if each.rollouts.size]


def curve(label: str, folders: Sequence[Path]) -> Curve:
    """The curve of runs with the same settings; those that have not started are left out."""
    return joined(label, [run for path in folders if len((run := _curve(path))[0])])


def _curve(path: Path) -> tuple[FloatArray, FloatArray]:
    """Rollouts before each mean policy of a run, and its return.

    The first line is the policy before learning.
    """
    folder = RunFolder(path)
    progress, summary = folder.progress(), folder.read_summary() or {}
    rollouts = [0, *(p.rollouts for p in progress)][: len(progress)]
    returns = [p.mean_policy_return for p in progress]
    # The evaluation's return belongs to the last update, unless an earlier policy was evaluated
    end = summary.get("generations")
    if (
        progress
        and summary.get("state") == "finished"
        and summary.get("policy_generation", end) == end
    ):
        rollouts = [*rollouts, progress[-1].rollouts]
        returns = [*returns, summary.get("mean_policy_return")]
    return np.array(rollouts, dtype=float), np.array(returns, dtype=float)


def joined(label: str, runs: Sequence[tuple[FloatArray, FloatArray]]) -> Curve:
    """Runs of one setting, each with its last return before each number of rollouts of any; nan
    after its end.
    """
    if not runs:
        return Curve(label, np.empty(0), np.empty((0, 0)))
    every = np.unique(np.concatenate([rollouts for rollouts, _ in runs]))
    returns = np.full((len(runs), len(every)), np.nan)
    for row, (rollouts, values) in zip(returns, runs, strict=True):
        until_end = every <= rollouts[-1]
        row[until_end] = values[np.searchsorted(rollouts, every[until_end], side="right") - 1]
    mask = ~np.isnan(returns).all(axis=0)
    return Curve(label, every[mask], returns[:, mask])
