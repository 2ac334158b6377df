"""A policy on perturbed starts, from Python; what `farm evaluate` does.

import farm

figures = farm.evaluate("runs/first", rollouts=1000)
print(figures["perturbed"]["success_rate"], figures["perturbed"]["return_mean"])
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from farm.arrays import IntArray
from farm.net.work import Simulated
from farm.seeds import SEEDS, evaluation_start
from farm.settings import Settings, setting
from farm.sim.mixed import names
from farm.tasks.base import TaskSpec
from farm.tasks.loop import Advance, unseen
from farm.tasks.rollouts import drawn
from learner.run.config import MOST_GENERATIONS
from learner.run.evaluation import (
    EVALUATION_ROLLOUTS,
    EVALUATION_SEED,
    evaluation_jobs,
    failures,
    statistics,
)
from learner.run.folder import opened
from learner.tools.replay.loaded import loaded


@dataclass(frozen=True, kw_only=True)
class Perturbed(Settings):
    """Number and seed of the starts from which a policy is evaluated."""

    rollouts: int = setting(EVALUATION_ROLLOUTS, least=1, most=1_000_000)
    """Number of perturbed rollouts."""
    seed: int = setting(EVALUATION_SEED, least=0, most=SEEDS - 1)
    """Seed of the perturbations."""
    average: int | None = setting(None, least=1, most=MOST_GENERATIONS)
    """Average the means after this number of last generations; by default the run's own policy."""


def evaluate(
    run: str | Path,
    *,
    rollouts: int = EVALUATION_ROLLOUTS,
    seed: int = EVALUATION_SEED,
    average: int | None = None,
    last: bool = False,
    allow_file: str | Path | Sequence[str | Path] | None = None,
    advance: Advance = unseen,
) -> dict[str, Any]:
    """Simulate a run's policy from its nominal start and from perturbed ones, in this process.

    Args:
      run: its folder.
      rollouts: number of perturbed starts.
      seed: of the perturbations; each start has its own of it.
      average: of so many last means, instead of the run's own policy.
      last: take the policy after the last generation, though a validated one is better.
      allow_file: files with classes of a run that somebody else made.
      advance: a function that is told how many rollouts are done, each time that some are.

    Returns:
      What `farm evaluate --json` prints: `run`, `generation` and `seed`; `nominal` and `perturbed`,
      each a table with `rollouts`, `success_rate` (None where the task knows no success),
      `return_mean`, `return_min`, `return_max`, `return_std` (None if all failed), `ended`,
      `failed`, and `measures` where the task has some. In `perturbed`, `worst_start` is the index
      of the start with the least return. Where rollouts have one of several models, `models` has
      such a table for each.

    Raises:
      ConfigError: there is no such run, or a number is out of range.

    Example:
      ```python
      import farm

      figures = farm.evaluate("runs/first", rollouts=20)
      worst = figures["perturbed"]["worst_start"]
      trajectory = farm.load("runs/first").rollout(seed=worst).trajectory
      assert trajectory.value == figures["perturbed"]["return_min"]
      ```
    """
    Perturbed(rollouts=rollouts, seed=seed, average=average)
    folder = opened(run, allow_file)
    policy = loaded(folder, average=average, last=last)
    spec = policy.problem.spec
    jobs = evaluation_jobs(rollouts, seed)
    results = policy.runner.run(policy.mu, jobs, advance=advance)
    figures: dict[str, Any] = {"run": folder.name, "generation": policy.generation, "seed": seed}
    figures["nominal"] = _figures(spec, results, np.array([rollouts]))
    figures["perturbed"] = _figures(spec, results, np.arange(rollouts))
    figures["perturbed"]["worst_start"] = int(np.argmin(results.returns[:rollouts]))
    task = policy.problem.task
    if len(task.simulated) > 1:
        which = drawn(
            task, [np.random.default_rng(evaluation_start(seed, i)) for i in range(rollouts)]
        )
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
