"""Rollouts per second of Gymnasium environments: in its own loop, and in the farm's, one by one and
in batches.

    python benchmarks/environments.py [--rollouts 64] [--steps 200] [--repeats 3]

One process, one thread, a linear policy with the same random parameters in all three. No rollout
ends early: rewards and observations are computed, but `terminated` is ignored. The best of the
repeats is shown.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from farm.policies.networks import Linear
from farm.runner import Runner
from farm.tasks.gymnasium import Environment, EnvironmentConfig, reset_seed
from farm.tasks.gymnasium_engine import make

NAMES = (
    *("Swimmer-v5", "Hopper-v5", "HalfCheetah-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5"),
    *("InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5"),
)


class OneByOne(Environment):
    """The same task, with each environment stepped by itself."""

    def __init__(self, config: EnvironmentConfig, name: str) -> None:
        super().__init__(config, name)
        self.batched, self.substeps = None, 1


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rollouts", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    count = arguments.rollouts
    print(
        "| environment | steps | Gymnasium's own loop [rollouts/s] | the farm, one by one | in a"
        " batch | ratio |"
    )
    print("|---|---|---|---|---|---|")
    for name in NAMES:
        steps = min(
            arguments.steps, 100 if name == "Pusher-v5" else 50 if name == "Reacher-v5" else 10_000
        )
        config = EnvironmentConfig(steps=steps)
        works = [
            _plain(name, config, count),
            *(_farm(kind, name, config, count) for kind in (OneByOne, Environment)),
        ]
        rates = [count / min(_seconds(work) for _ in range(arguments.repeats)) for work in works]
        print(f"| {name} | {steps} | " + " | ".join(f"{rate:.0f}" for rate in rates), end="")
        print(f" | {rates[2] / rates[0]:.1f} |", flush=True)


def _theta(policy: Linear, count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, 0.3, (count, policy.size))


def _plain(name: str, config: EnvironmentConfig, count: int) -> Callable[[], object]:
    task = Environment(config, name)
    policy, env = Linear(Linear.Config(), task.spec(), {}), make(name)
    low, high = task.limits
    theta = _theta(policy, count).reshape(count, len(low), -1)

    def work() -> None:
        for row in range(count):
            x, _ = env.reset(seed=reset_seed(np.random.default_rng((3, 0, row, 0))))
            for _ in range(task.steps):
                raw = np.clip((theta[row, :, :-1] * x).sum(axis=-1) + theta[row, :, -1], -1.0, 1.0)
                x, *_ = env.step((low + (high - low) * (0.5 * (raw + 1.0))).astype(np.float32))

    return work


def _farm(
    kind: type[Environment], name: str, config: EnvironmentConfig, count: int
) -> Callable[[], object]:
    task = kind(config, name)
    task.ended = lambda sim: np.zeros(len(sim), dtype=bool)  # type: ignore[method-assign]
    policy = Linear(Linear.Config(), task.spec(), {})
    runner, theta = Runner(task, policy), _theta(policy, count)
    return lambda: runner.rollouts(theta, [(3, 0, row, 0) for row in range(count)])


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


if __name__ == "__main__":
    from running import script

    script(main)
