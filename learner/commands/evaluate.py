"""`farm evaluate`: the learnt mean policy on perturbed starts."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from farm import settings
from farm.commands.logs import say
from farm.seeds import SEEDS
from farm.settings import Settings, setting
from learner.evaluation import EVALUATION_ROLLOUTS, EVALUATION_SEED, evaluation_jobs
from learner.replay import loaded
from learner.run_folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(Settings):
    """Tests the learnt mean policy on perturbed starts and conditions drawn by its task."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    rollouts: int = setting(EVALUATION_ROLLOUTS, least=1, most=1_000_000)
    """Number of perturbed rollouts."""
    seed: int = setting(EVALUATION_SEED, least=0, most=SEEDS - 1)
    """Seed of the perturbations."""
    average: int | None = setting(None, least=1)
    """Average the means after this number of last generations; by default the run's own setting."""
    json: bool = False
    """Print JSON instead of a table."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = settings.parse(EvaluateCommand, words, "farm evaluate")
    figures = evaluate(RunFolder.open(command.run), command.rollouts, command.seed, command.average)
    if command.json:
        say(json.dumps(figures, indent=2))
        return 0
    table = Table(title=f"{figures['run']}, mean policy after generation {figures['generation']}")
    for column in ("conditions", "rollouts", "success", "return mean", "min", "max", "ended early"):
        table.add_column(column, justify="left" if column == "conditions" else "right")
    for name in ("nominal", "perturbed"):
        row = figures[name]
        success = "-" if row["success_rate"] is None else f"{row['success_rate']:.0%}"
        returns = [f"{row[key]:.3f}" for key in ("return_mean", "return_min", "return_max")]
        table.add_row(name, str(row["rollouts"]), success, *returns, str(row["ended"]))
    Console().print(table)
    return 0


def evaluate(folder: RunFolder, rollouts: int, seed: int, average: int | None = None) -> dict[str, Any]:
    """The figures in the JSON's form."""
    policy = loaded(folder, average=average)
    spec = policy.problem.spec
    given = policy.runner.run(policy.mu, evaluation_jobs(rollouts, seed))
    figures: dict[str, Any] = {"run": folder.name, "generation": policy.generation, "seed": seed}
    for name, rows in (("nominal", slice(rollouts, None)), ("perturbed", slice(rollouts))):
        returns, flags = given.returns[rows], given.flags[rows]
        figures[name] = {
            "rollouts": len(returns),
            "success_rate": float(flags[:, 0].mean()) if spec.success else None,
            "return_mean": float(returns.mean()),
            "return_min": float(returns.min()),
            "return_max": float(returns.max()),
            "ended": int(flags[:, 1].sum()),
            "failed": int(flags[:, 2].sum()),
        }
    return figures
