"""Every algorithm with every policy, each with the same budget, on the gait and three environments;
one table each.

    python benchmarks/learners.py [--tasks gait,Reacher-v5] [--policies linear] [--seeds 5] [--out
        FILE.jsonl]

Nothing is tuned: each policy has the same start and initial sigma with all algorithms. Population
and learning rates are the algorithms' defaults, and PGPE is that of Toklu 2020 (ranks, ClipUp with
a speed derived from sigma). The seeds of a cell are simulated together in this process; the results
are the same as those of `farm run`.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.moments import merged, normaliser_of, usable
from farm.runner import Runner
from farm.tasks import loop
from farm.tasks.loop import Kept
from farm.tasks.rollouts import Rollouts, Seed
from learner.run import setup
from learner.run.config import RunConfig, configure
from learner.run.learner import explored, learnt_from

ALGORITHMS: Final[Mapping[str, dict[str, Any]]] = {
    "pgpe": {
        "pairs": 10,
        "shaping": "ranks",
        "optimiser": "clipup",
        "sigma_rule": "capped",
        "learning_rate_sigma": 0.1,
    },
    "snes": {"pairs": 10},
    "ars": {"pairs": 10},
    "cma-es": {"population": 20},
    "sep-cma": {"population": 20},
}
"""Settings of each algorithm, apart from start and sigma; twenty rollouts per generation."""

GAIT: Final[Mapping[str, dict[str, Any]]] = {
    "constant": {"initial_mu": 0.0, "initial_sigma": 0.2},
    "linear": {"initial_mu": 0.0, "initial_sigma": 0.1},
    "kernel": {"initial_mu": 1.5, "initial_sigma": 0.3},
    "weighted-kernel": {"initial_mu": 0.0, "initial_sigma": 1.0},
}
ENVIRONMENTS: Final[Mapping[str, dict[str, Any]]] = {
    "linear": {"normalise": True, "initial_mu": 0.0, "initial_sigma": 0.05},
    "mlp": {"normalise": True, "layers": (16,), "initial_mu": 0.0, "initial_sigma": 0.05},
    "rbf": {"normalise": True, "bandwidth": 3.0, "initial_mu": 0.0, "initial_sigma": 0.2},
}
"""Policies of the environments, and the start of their search."""

TASKS: Final[Mapping[str, tuple[str, int, Mapping[str, dict[str, Any]]]]] = {
    "gait": ("finger-gait", 900, GAIT),
    "Reacher-v5": ("gym:Reacher-v5", 1000, ENVIRONMENTS),
    "InvertedDoublePendulum-v5": ("gym:InvertedDoublePendulum-v5", 1000, ENVIRONMENTS),
    "Hopper-v5": ("gym:Hopper-v5", 1000, ENVIRONMENTS),
}
"""Task, exploring rollouts, policies."""

ENOUGH: Final = 0.95
LOOK: Final = 150  # rollouts between two tests of the gait
STARTS: Final = 40  # perturbed starts per test


@dataclass
class Search:
    """One seed."""

    config: RunConfig
    problem: setup.Problem
    state: Any
    moments: FloatArray
    rollouts: int = 0

    def seen(self) -> FloatArray:
        """Mean and standard deviation of the observations so far, (2, d)."""
        return normaliser_of(self.moments)


class SideBySide:
    """Policies of several searches in one batch: the last number of a row is the index of its
    search.
    """

    def __init__(self, searches: Sequence[Search]) -> None:
        self.policies = [search.problem.policy for search in searches]
        self.seen = np.stack([search.seen() for search in searches])

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Return theta: each policy prepares its own rows in `act`."""
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d)."""
        owners = prepared[:, -1].astype(int)
        if self.seen.size:
            with np.errstate(over="ignore", invalid="ignore"):
                x = (x - self.seen[owners, 0]) / self.seen[owners, 1]
        policy = self.policies[0]  # the same for all seeds: none of these policies draws constants
        return policy.act(policy.prepare(np.ascontiguousarray(prepared[:, :-1])), x)


def main() -> None:
    """Learn, and print a table for each task."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--policies", help="only these, for example mlp,rbf")
    parser.add_argument("--first", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--out", type=Path, help="file to which each row's numbers are added, as a line of JSON"
    )
    arguments = parser.parse_args()
    numbers = range(arguments.first, arguments.first + arguments.seeds)
    for name in arguments.tasks.split(","):
        task, budget, policies = TASKS[name]
        print(f"\n{name}, {budget} rollouts, seeds {numbers[0]} to {numbers[-1]}\n")
        print(f"| policy | {' | '.join(ALGORITHMS)} |\n|---|{'---|' * len(ALGORITHMS)}")
        for policy in arguments.policies.split(",") if arguments.policies else policies:
            if policy not in policies:
                parser.error(f"{name} has no policy {policy!r}; it has {', '.join(policies)}")
            start = policies[policy]
            cells = []
            for algorithm, options in ALGORITHMS.items():
                row = _row(
                    task,
                    budget,
                    {"policy": policy, "algorithm": algorithm, **options, **start},
                    numbers,
                )
                cells.append(_cell(row))
                if arguments.out:
                    with arguments.out.open("a") as file:
                        file.write(
                            json.dumps(
                                {"task": name, "policy": policy, "algorithm": algorithm, **row}
                            )
                            + "\n"
                        )
            print(f"| {policy} | {' | '.join(cells)} |", flush=True)


def _cell(row: Mapping[str, Any]) -> str:
    returns = sorted(row["returns"])
    text = f"{np.median(returns):.4g} ({returns[0]:.4g} to {returns[-1]:.4g})"
    if "since" not in row:
        return text
    since = [at for at in row["since"] if at is not None]
    return (
        f"{len(since)} of {len(returns)}"
        + (f", {np.median(since):.0f}; " if since else "; ")
        + text
    )


def _row(
    task: str, budget: int, settings: dict[str, Any], numbers: Sequence[int]
) -> dict[str, Any]:
    searches = [_begun(task, settings, number) for number in numbers]
    runner, looks = searches[0].problem.runner(), []
    gait = searches[0].problem.spec.success
    while any(search.rollouts < budget for search in searches):
        _generation(runner, searches)
        if gait and searches[0].rollouts // LOOK > len(looks):
            looks.append(
                (
                    searches[0].rollouts,
                    *(each.success.mean() for each in _tried(runner, searches, 0)),
                )
            )
    final = _tried(runner, searches, 1)
    row: dict[str, Any] = {"returns": [round(float(each.returns.mean()), 4) for each in final]}
    if gait:
        row["success"] = [float(each.success.mean()) for each in final]
        row["since"] = [_since([(at[0], at[1 + i]) for at in looks]) for i in range(len(searches))]
    return row


def _begun(task: str, settings: dict[str, Any], number: int) -> Search:
    config = configure(task, seed=number, perturb=True, generations=1_000_000, **settings)
    problem = setup.problem(config)
    # Toklu 2020: the radius of the search is fifteen steps of the highest speed
    if config.algorithm == "pgpe":
        speed = settings["initial_sigma"] * float(np.sqrt(problem.policy.size)) / 15.0
        speeds = {"max_speed": speed, "learning_rate_mu": speed / 2.0}
        config = configure(
            task, seed=number, perturb=True, generations=1_000_000, **settings, **speeds
        )
    state = config.algorithm_config.init(problem.policy.size)
    size = problem.spec.observation if config.policy_config.normalise else 0
    return Search(config, problem, state, np.zeros(1 + 2 * size if size else 0))


def _generation(runner: Runner, searches: Sequence[Search]) -> None:
    proposals = [explored(search.config, search.state) for search in searches]
    thetas = [
        jobs.theta(search.state.mu) for search, (_, jobs) in zip(searches, proposals, strict=True)
    ]
    starts = [start for _, jobs in proposals for start in jobs.seeds()]
    results = _together(runner, searches, thetas, starts)
    for search, (eps, _), rollouts in zip(searches, proposals, results, strict=True):
        returns = learnt_from(search.config, search.problem.task, rollouts.returns, rollouts.steps)
        search.state = search.config.algorithm_config.tell(search.state, eps, returns)
        search.rollouts += len(rollouts.returns)
        if search.moments.size:
            table = np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))
            search.moments = merged(search.moments, table)


def _tried(runner: Runner, searches: Sequence[Search], seed: int) -> list[Rollouts]:
    """The mean policies on perturbed starts."""
    thetas = [np.repeat(search.state.mu[None], STARTS, axis=0) for search in searches]
    return _together(
        runner,
        searches,
        thetas,
        [streams.evaluation_start(seed, i) for i in range(STARTS)] * len(searches),
    )


def _together(
    runner: Runner, searches: Sequence[Search], thetas: Sequence[FloatArray], starts: Sequence[Seed]
) -> list[Rollouts]:
    """Rollouts of each search's parameters, simulated together."""
    rows = [np.column_stack([theta, np.full(len(theta), i)]) for i, theta in enumerate(thetas)]
    policy, moments = SideBySide(searches), bool(searches[0].moments.size)
    kept = Kept(moments=moments)
    rollouts, _ = loop.run(
        runner.task, policy, runner.sim, np.concatenate(rows), starts, runner.spec, kept
    )
    ends = np.cumsum([len(theta) for theta in thetas])
    return [
        rollouts.at(slice(end - len(theta), end))
        for end, theta in zip(ends.tolist(), thetas, strict=True)
    ]


def _since(looks: Sequence[tuple[int, float]]) -> int | None:
    """The first test from which on all results are good enough."""
    below = [at for at, (_, good) in enumerate(looks) if good < ENOUGH]
    first = below[-1] + 1 if below else 0
    return looks[first][0] if first < len(looks) else None


if __name__ == "__main__":
    from running import script

    script(main)
