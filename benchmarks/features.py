"""The share of physics in rollouts whose controller has thousands of random features, on one core;
one table.

    python benchmarks/features.py [--features 8000] [--turns 5]

Thirty rollouts of the finger gait with perturbed starts, in the preset `thesis`, with small random
parameters. Their rate of physics steps is divided by that of MuJoCo alone from the same starts,
measured just before and after.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import mujoco.batch
import numpy as np

from farm.runner import Runner
from farm.tasks.loop import Batch, again
from learner.run.config import configure
from learner.run.setup import problem

ROLLOUTS = 30
STEPS = 400  # physics steps of a measurement of MuJoCo alone
SEEDS = [(row // 2,) for row in range(ROLLOUTS)]
CASES = [
    ("kernel", {}),
    *(
        (name, {"precision": each})
        for name in ("projected", "direct")
        for each in ("double", "single")
    ),
]


def main() -> None:
    """Measure each controller in turn, several times; print medians."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--features", type=int, default=8000)
    parser.add_argument("--turns", type=int, default=5)
    arguments = parser.parse_args()
    runners: dict[str, Runner] = {}
    for policy, options in CASES:
        settings = {"features": arguments.features, **options} if options else {}
        name = " ".join([policy, *options.values()])
        runners[name] = problem(configure(preset="thesis", policy=policy, **settings)).runner()
    shares: dict[str, list[float]] = {name: [] for name in runners}
    for _ in range(arguments.turns):
        for name, runner in runners.items():
            before = _physics(runner)
            shares[name].append(2.0 * _rollouts(runner) / (before + _physics(runner)))
    print(f"D {arguments.features}, medians of {arguments.turns} turns (lowest to highest)\n")
    print("| controller | speed relative to MuJoCo alone |\n|---|---|")
    for name, values in shares.items():
        print(
            f"| {name} | {statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f}) |"
        )


def _rollouts(runner: Runner) -> float:
    """Physics steps per second of whole rollouts, without those that close the grip."""
    theta = np.random.default_rng(0).normal(0.0, 1e-3, (ROLLOUTS, runner.size))
    rollouts = runner.rollouts(theta, SEEDS)
    seconds = _duration(lambda: runner.rollouts(theta, SEEDS)) - _duration(lambda: _begun(runner))
    return float(rollouts.steps.sum()) * runner.task.substeps / seconds


def _physics(runner: Runner) -> float:
    """Physics steps per second of MuJoCo alone."""
    _begun(runner)
    sim = runner.sim
    bare = mujoco.batch.Batch(sim.model, ROLLOUTS, 1)
    for name in ("qpos", "qvel", "ctrl", "eq_active", "mocap_pos", "mocap_quat"):
        bare.bind(name)[:] = getattr(sim, name)
    return ROLLOUTS * STEPS / _duration(lambda: bare.step(nstep=STEPS))


def _begun(runner: Runner) -> Batch:
    return again(lambda: Batch(runner.task, runner.sim, SEEDS))


def _duration(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


if __name__ == "__main__":
    from running import script

    script(main)
