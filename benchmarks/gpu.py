"""Physics steps per second of the backend `warp` and of MuJoCo on this machine's processor; one
table.

    python benchmarks/gpu.py [--worlds 1024,4096,16384] [--tasks
        finger-gait,gym:Ant-v5,gym:HalfCheetah-v5] [--steps 20] [--threads 2,16]

Each row times rollouts of a random linear policy from perturbed starts, with all parts of a control
step: observation, action, reward. Physics steps before the start (closing a grip) take time but are
not counted. Compilation is not timed. Without a GPU, MuJoCo Warp simulates slowly on the processor:
use few worlds.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from farm import configure, seeds
from farm.runner import Runner, make_backend
from farm.sim.engines import BatchEngine
from farm.sim.interfaces import MakeEngine
from learner.run import setup


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", default="1024,4096,16384")
    parser.add_argument("--tasks", default="finger-gait,gym:Ant-v5,gym:HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=20, help="control steps per rollout")
    parser.add_argument(
        "--threads", default="2,16", help="numbers of MuJoCo's threads on the processor"
    )
    arguments = parser.parse_args()
    print("| task | simulated by | together | physics steps/s |\n|---|---|---|---|")
    for name in arguments.tasks.split(","):
        for count in map(int, arguments.threads.split(",")):
            row(name, f"{count} threads", 256, arguments.steps, threads(count, 256))
        for worlds in map(int, arguments.worlds.split(",")):
            backend = make_backend("warp")
            backend.__class__.capacity = worlds
            row(name, "warp", worlds, arguments.steps, backend.engine, exact=False)


def threads(count: int, size: int) -> MakeEngine:
    """Makes MuJoCo engines with this number of threads."""
    make: Callable[..., BatchEngine] = BatchEngine
    return lambda model: make(model, size, count)


def row(
    name: str, by: str, worlds: int, steps: int, make: MakeEngine, *, exact: bool = True
) -> None:
    """Run once to compile, run again, and print."""
    problem = setup.problem(configure(name, policy="linear", steps=steps))
    runner = Runner(problem.task, problem.policy, make, exact=exact)
    theta = 0.1 * np.random.default_rng(0).standard_normal((worlds, runner.size))
    starts: list[tuple[int, ...] | None] = [seeds.evaluation_start(0, i) for i in range(worlds)]
    runner.rollouts(theta, starts)
    start = time.perf_counter()
    done = runner.rollouts(theta, starts)
    speed = problem.task.substeps * done.steps.sum() / (time.perf_counter() - start)
    print(f"| {name} | {by} | {worlds} | {speed:.3g} |", flush=True)


if __name__ == "__main__":
    from running import script

    script(main)
