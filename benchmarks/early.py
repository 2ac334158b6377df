"""Finds the rollouts after which a preset's mean policy succeeds (results: docs/results/seeds.md).

One process.

    python benchmarks/early.py [--preset default] [--first 20] [--seeds 10] [--policy constant]

The mean policy is tested on 100 perturbed starts after every generation of the first 500 rollouts,
then after every 15th generation and the last; on the nominal start after every 5th. `--policy
constant` learns 8 joint commands without feedback.
"""

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np

from farm import Policy, seeds
from farm.arrays import FloatArray
from farm.runner import Runner
from learner.run import setup
from learner.run.config import configure

TRIALS = 100
ENOUGH = 95  # of them
GOOD = -0.08  # return on the nominal start
DENSE = 500  # rollouts


class Constant(Policy):
    """a = theta, for every observation."""

    @property
    def size(self) -> int:
        """One number per action."""
        return self.spec.action

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:  # noqa: ARG002
        """The parameters, (B, A)."""
        return prepared


@dataclass
class Curve:
    """Results of the mean policy, each with the number of exploring rollouts."""

    robust: list[tuple[int, int]]
    nominal: list[tuple[int, float]]

    def look(
        self, runner: Runner, mu: FloatArray, rollouts: int, *, robust: bool, nominal: bool
    ) -> None:
        """Test a mean policy."""
        if robust:
            trials = [seeds.evaluation_start(0, i) for i in range(TRIALS)]
            results = runner.rollouts(np.repeat(mu[None], TRIALS, axis=0), trials)
            self.robust.append((rollouts, int(results.success.sum())))
        if nominal:
            self.nominal.append((rollouts, float(runner.rollouts(mu[None], [None]).returns[0])))


def main() -> None:
    """Learn, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", default="default")
    parser.add_argument("--first", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--policy", choices=("own", "constant"), default="own")
    arguments = parser.parse_args()
    constant: dict[str, Any] = {
        "policy": f"{__file__}:Constant",
        "initial_mu": 0.0,
        "initial_sigma": 0.1,
    }
    changed = constant if arguments.policy == "constant" else {}
    numbers = range(arguments.first, arguments.first + arguments.seeds)
    configs = {
        seed: configure("finger-gait", arguments.preset, seed=seed, **changed) for seed in numbers
    }
    print(
        f"| seed | robust success >= {ENOUGH} % from rollout on | return >= {GOOD} from"
        " rollout on ",
        end="",
    )
    print("| return, last | robust success, lowest in the last half, last |\n|---|---|---|---|---|")
    runner: Runner | None = None
    for seed, config in configs.items():
        curve, runner = _learnt(config, runner)
        half = [value for rollouts, value in curve.robust if 2 * rollouts >= curve.robust[-1][0]]
        print(
            f"| {seed} | {_since(curve.robust, ENOUGH)} | {_since(curve.nominal, GOOD)} "
            f"| {curve.nominal[-1][1]:.4f} | {min(half)} %, {curve.robust[-1][1]} % |",
            flush=True,
        )


def _learnt(config: Any, runner: Runner | None) -> tuple[Curve, Runner]:  # noqa: ANN401  a RunConfig
    """Learn one run."""
    problem, algorithm, curve = setup.problem(config), config.algorithm_config, Curve([], [])
    runner = runner or problem.runner()
    runner.policy = problem.policy
    state, per, last = algorithm.init(problem.policy.size), 2 * algorithm.pairs, config.generations
    for generation in range(last + 1):
        rollouts, end = per * generation, generation == last
        dense = rollouts <= DENSE or generation % 15 == 0 or end
        curve.look(runner, state.mu, rollouts, robust=dense, nominal=generation % 5 == 0 or end)
        if not end:
            eps = algorithm.ask(state, seeds.exploration(config.seed, generation))
            theta = (state.mu + eps[:, None] * np.array([1.0, -1.0])[:, None]).reshape(per, -1)
            perturb = config.task_config.perturb
            starts = [
                seeds.training(config.seed, generation, row // 2) if perturb else None
                for row in range(per)
            ]
            returns = runner.rollouts(theta, starts).returns.reshape(-1, 2)
            state = algorithm.tell(state, eps, returns)
    return curve, runner


def _since(values: list[tuple[int, Any]], least: float) -> str:
    """The first number of rollouts from which on all results are good enough."""
    below = [at for at, (_, value) in enumerate(values) if value < least]
    first = below[-1] + 1 if below else 0
    return str(values[first][0]) if first < len(values) else "-"


if __name__ == "__main__":
    from running import script

    script(main)
