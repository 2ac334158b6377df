"""Compares published scores of linear policies with ours: settings, published score, our score; one
row per seed.

    python benchmarks/tables.py TABLE ENVIRONMENT [--seed S ...] [--out FILE]

    python benchmarks/tables.py ars Hopper-v5 --seed 0 1 2
    python benchmarks/tables.py --list

Runs with several seeds are simulated together in one batch, in this process. The last lines have a
`farm run` command that gives the same results to the last bit. The score is the mean return of the
last mean policy from 100 new starts.

`--state FILE` saves the runs to FILE every minute and on Ctrl-C; the same command continues them,
to the same bits.
"""

import argparse
import hashlib
import itertools
import json
import shlex
import signal
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import FloatArray, IntArray
from farm.commands.signals import INTERRUPTED
from farm.moments import merged, normaliser_of, usable
from farm.runner import Runner
from farm.tasks import loop
from farm.tasks.loop import Kept
from farm.tasks.rollouts import Rollouts, Seed
from learner.run import setup
from learner.run.config import RunConfig, configure

LOOKS: Final = 20  # points of the learning curve


@dataclass(frozen=True)
class Row:
    """A line of a published table."""

    settings: Mapping[str, Any]
    score: float
    spread: float | None
    """Standard deviation over the evaluation's rollouts."""


def _ars(alpha: float, nu: float, pairs: int, top: int, steps: int, **more: Any) -> dict[str, Any]:  # noqa: ANN401
    return {
        "policy": "linear",
        "algorithm": "ars",
        "learning_rate_mu": alpha,
        "initial_sigma": nu,
        "pairs": pairs,
        "top": top,
        "stop_after_steps": steps,
        **more,
    }


_KNOWN: Final[Mapping[str, Any]] = {"normalise": True}
_BONUS: Final[Mapping[str, Any]] = {"normalise": True, "reward_offset": -1.0}

TABLES: Final[Mapping[str, Mapping[str, Row]]] = {
    # rl-baselines3-zoo, hyperparams/ars.yml and benchmark.md: one run each, of v3 environments.
    "ars": {
        "Swimmer-v5": Row(_ars(0.02, 0.01, 1, 1, 2_000_000, bias=False), 355.267, 12.796),
        "Hopper-v5": Row(_ars(0.01, 0.025, 8, 4, 7_000_000, **_BONUS), 3343.919, 5.730),
        "HalfCheetah-v5": Row(_ars(0.02, 0.03, 32, 4, 12_500_000, **_KNOWN), 4815.192, 1340.752),
        "Walker2d-v5": Row(_ars(0.03, 0.025, 40, 30, 75_000_000, **_BONUS), 2993.582, 166.289),
        "Ant-v5": Row(_ars(0.015, 0.025, 60, 20, 75_000_000, **_BONUS), 2333.773, 20.597),
    },
    # pgpelib, README.md: its linear policy; radius 0.225 = sigma sqrt(108), step size half the
    # maximum speed.
    "clipup": {
        "Walker2d-v5": Row(
            {
                "policy": "linear",
                "bias": False,
                "normalise": True,
                "algorithm": "pgpe",
                "shaping": "ranks",
                "optimiser": "clipup",
                "pairs": 50,
                "most_pairs": 400,
                "interactions": 75_000,
                "generations": 500,
                "max_speed": 0.015,
                "learning_rate_mu": 0.0075,
                "momentum": 0.9,
                "initial_sigma": 0.02165,
                "sigma_rule": "capped",
                "sigma_cap": 0.2,
                "learning_rate_sigma": 0.1,
                "initial_mu": 0.0,
                "reward_offset": -1.0,
            },
            5232.0,
            None,
        ),
    },
}
# With one direction (Swimmer, pairs 1) the spread of returns that ARS divides by is that of its two
# returns.


@dataclass
class Search:
    """One seed's run."""

    config: RunConfig
    policy: Any
    state: Any
    moments: FloatArray
    steps: int = 0
    pairs: int = 0
    curve: list[tuple[int, float]] = field(default_factory=list)
    eps: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def over(self) -> bool:
        """Whether its budget of steps is used up."""
        spent = (
            self.config.stop_after_steps is not None and self.steps >= self.config.stop_after_steps
        )
        return spent or self.state.generation >= self.config.generations

    @property
    def algorithm(self) -> Any:  # noqa: ANN401
        """The algorithm, with the number of pairs of this generation."""
        return self.config.algorithm_of(self.pairs)

    def ask(self) -> tuple[FloatArray, list[Seed]]:
        """Parameters of its next generation, (2 N, P), and seeds of their starts."""
        config, generation = self.config, self.state.generation
        self.eps = self.algorithm.ask(self.state, seeds.exploration(config.seed, generation))
        theta = (self.state.mu + self.eps[:, None] * np.array([1.0, -1.0])[:, None]).reshape(
            2 * len(self.eps), -1
        )
        return theta, [
            seeds.training(config.seed, generation, row // 2) for row in range(len(theta))
        ]

    def tell(self, rollouts: Rollouts, offsets: FloatArray) -> None:
        """Update the state from their returns."""
        returns = (rollouts.returns + offsets[rollouts.steps]).reshape(-1, 2)
        self.state = self.algorithm.tell(self.state, self.eps, returns)
        steps = int(rollouts.steps.sum())
        self.steps, self.pairs = self.steps + steps, self.config.pairs_after(self.pairs, steps)
        if self.config.policy_config.normalise:
            self.moments = merged(
                self.moments, np.where(rollouts.failed[:, None], 0.0, usable(rollouts.moments))
            )
        self.curve.append((self.steps, float(rollouts.returns.mean())))

    def saved(self) -> dict[str, Any]:
        """Everything that `restore` needs to continue, by name."""
        values = {
            "steps": self.steps,
            "pairs": self.pairs,
            "moments": self.moments,
            "curve": np.array(self.curve),
        }
        return values | {
            f"state.{name}": value
            for name, value in self.state.to_dict().items()
            if value is not None
        }

    def restore(self, values: Mapping[str, Any]) -> None:
        """Continue from values of `saved`."""
        fields = {
            name.partition(".")[2]: value
            for name, value in values.items()
            if name.startswith("state.")
        }
        empty = dict.fromkeys(self.state.to_dict())
        self.state = self.state.from_dict(
            empty | {n: v if v.ndim else v.item() for n, v in fields.items()}
        )
        self.steps = int(values["steps"])
        self.pairs = int(values["pairs"])
        self.moments = values["moments"]
        self.curve = [(int(at), float(value)) for at, value in values["curve"]]

    def extended(self, theta: FloatArray) -> FloatArray:
        """Parameters (B, P), each row followed by mean and standard deviation of its observations,
        (B, P + 2 d).
        """
        return np.hstack([theta, np.tile(normaliser_of(self.moments).ravel(), (len(theta), 1))])


class SideBySide:
    """A policy whose parameters (P,) are followed by a mean and a standard deviation of
    observations (d,) each.
    """

    def __init__(self, policy: Any) -> None:  # noqa: ANN401
        self.policy, self.size, self.d = policy, policy.size, policy.spec.observation

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Return theta: a linear policy needs no preparation."""
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d)."""
        mean = prepared[:, self.size : self.size + self.d]
        deviation = prepared[:, self.size + self.d :]
        with np.errstate(over="ignore", invalid="ignore"):
            z = (x - mean) / deviation
        return self.policy.act(np.ascontiguousarray(prepared[:, : self.size]), z)


def main() -> None:
    """Learn, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", nargs="?", choices=tuple(TABLES))
    parser.add_argument("environment", nargs="?")
    parser.add_argument("--seed", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--steps", type=int, help="budget of environment steps per seed, instead of the table's"
    )
    parser.add_argument("--starts", type=int, default=100, help="number of rollouts for the score")
    parser.add_argument(
        "--out", type=Path, help="file to which each seed's numbers are added, as a line of JSON"
    )
    parser.add_argument(
        "--state",
        type=Path,
        help="file from which interrupted runs continue, for example state.npz",
    )
    parser.add_argument("--list", action="store_true")
    arguments = parser.parse_args()
    if arguments.list or arguments.table is None:
        for table, rows in TABLES.items():
            for environment, row in rows.items():
                print(f"{table} {environment}: {row.score:.0f}; {_flags(row.settings)}")
        return
    row = TABLES[arguments.table].get(arguments.environment)
    if row is None:
        parser.error(
            f"{arguments.table} has no {arguments.environment}; it has"
            f" {', '.join(TABLES[arguments.table])}"
        )
    values = dict(row.settings) | ({"stop_after_steps": arguments.steps} if arguments.steps else {})
    task = f"gym:{arguments.environment}"
    searches, runner = _begun(task, values, arguments.seed)
    if arguments.state and arguments.state.exists():
        _load(arguments.state, searches)
    start, before = time.monotonic(), sum(search.steps for search in searches)
    _learn(searches, runner, arguments.state)
    print(
        f"| environment | seed | settings | steps | published | ours, {arguments.starts} starts |"
        " parameters |"
    )
    print("|---|---|---|---|---|---|---|")
    for search in searches:
        returns, steps = _score(search, runner, arguments.starts)
        numbers = (
            search.state.mu.astype("<f8").tobytes() + search.state.sigma.astype("<f8").tobytes()
        )
        digest = hashlib.sha256(numbers).hexdigest()[:16]
        published = f"{row.score:.0f}" + ("" if row.spread is None else f" +/- {row.spread:.0f}")
        print(
            f"| {arguments.environment} | {search.config.seed} | {_flags(values)} | {search.steps}"
            f" | {published} | {returns.mean():.0f} +/- {returns.std():.0f} | {digest} |"
        )
        record = {
            "table": arguments.table,
            "environment": arguments.environment,
            "seed": search.config.seed,
            "steps": search.steps,
            "generations": search.state.generation,
            "return": round(float(returns.mean()), 3),
            "spread": round(float(returns.std()), 3),
            "length": round(float(steps.mean()), 1),
            "parameters": digest,
            "curve": [[at, round(value, 1)] for at, value in _thinned(search.curve)],
        }
        if arguments.out:
            with arguments.out.open("a") as file:
                file.write(json.dumps(record) + "\n")
    total = sum(search.steps for search in searches) - before
    values = {"generations": _MOST, **values}
    print(f"\nfarm run --task {task} {_flags(values)} --seed S    gives the same parameters")
    print(f"{total / (time.monotonic() - start):.0f} steps/s in this process")


_MOST: Final = 1_000_000  # generations: runs end by their number of steps


def _begun(task: str, values: Mapping[str, Any], numbers: list[int]) -> tuple[list[Search], Runner]:
    searches, runner = [], None
    for number in numbers:
        settings: dict[str, Any] = {"generations": _MOST, **values}
        config = configure(task, seed=number, **settings)
        problem = setup.problem(config)
        runner = runner or problem.runner()
        state = config.algorithm_config.init(problem.policy.size)
        searches.append(
            Search(config, problem.policy, state, np.zeros(1 + 2 * problem.spec.observation))
        )
    assert runner is not None
    return searches, runner


def _save(path: Path, searches: list[Search]) -> None:
    arrays = {
        f"{s.config.seed}.{name}": value for s in searches for name, value in s.saved().items()
    }
    aside = path.with_suffix(".new.npz")
    np.savez(aside, allow_pickle=False, **arrays)
    aside.replace(path)


def _load(path: Path, searches: list[Search]) -> None:
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    for search in searches:
        first = f"{search.config.seed}."
        search.restore(
            {
                name.removeprefix(first): value
                for name, value in arrays.items()
                if name.startswith(first)
            }
        )


def _learn(searches: list[Search], runner: Runner, saved: Path | None = None) -> None:
    """Run all seeds to their end, one generation of each at a time."""
    stopped = threading.Event()
    for which in (signal.SIGINT, signal.SIGTERM) if saved else ():
        signal.signal(which, lambda *_: stopped.set())
    config, task = searches[0].config, runner.task
    offset = config.task_config.reward_offset
    offsets = np.array([0.0, *itertools.accumulate([task.return_scale * offset] * task.steps)])
    policy, last = SideBySide(searches[0].policy), time.monotonic()
    going = searches
    while going := [search for search in going if not search.over]:
        proposals = [search.ask() for search in going]
        theta = np.concatenate(
            [search.extended(rows) for search, (rows, _) in zip(going, proposals, strict=True)]
        )
        starts = [start for _, each in proposals for start in each]
        moments = config.policy_config.normalise
        rollouts, _ = loop.run(
            task, policy, runner.sim, theta, starts, runner.spec, Kept(moments=moments)
        )
        first = 0
        for search, (rows, _) in zip(going, proposals, strict=True):
            search.tell(rollouts.at(slice(first, first + len(rows))), offsets)
            first += len(rows)
        if saved and (stopped.is_set() or time.monotonic() - last > 60):
            _save(saved, searches)
        if stopped.is_set():
            sys.stderr.write(f"stopped; the same command continues from {saved}\n")
            sys.exit(INTERRUPTED)
        if time.monotonic() - last > 60:
            last = time.monotonic()
            now = ", ".join(f"{s.steps / 1e6:.2f}M {s.curve[-1][1]:.0f}" for s in going)
            print(f"# {now}", file=sys.stderr, flush=True)


def _score(search: Search, runner: Runner, count: int) -> tuple[FloatArray, IntArray]:
    """Returns and lengths of the mean policy's rollouts."""
    theta = search.extended(np.tile(search.state.mu, (count, 1)))
    starts = [seeds.evaluation_start(0, i) for i in range(count)]
    rollouts, _ = loop.run(
        runner.task, SideBySide(search.policy), runner.sim, theta, starts, runner.spec
    )
    return rollouts.returns, rollouts.steps


def _thinned(curve: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """Evenly chosen points of the curve, with the last."""
    picked = np.unique(np.linspace(0, len(curve) - 1, LOOKS).astype(int))
    return [curve[at] for at in picked.tolist()]


def _flags(values: Mapping[str, Any]) -> str:
    words = []
    for name, value in values.items():
        flag = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{name.replace('_', '-')}")
        else:
            words += [flag, f"{value:g}" if isinstance(value, float) else str(value)]
    return shlex.join(words)


if __name__ == "__main__":
    from running import script

    script(main)
