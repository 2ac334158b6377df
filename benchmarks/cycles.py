"""Learns a whole cycle of grips, and counts the cycles until the bar is lost; one table.

    python benchmarks/cycles.py [--seeds 20,21,22,23,24] [--states touch,joints,phase] [--object crowned-bar]
        [--out runs/cycles]

The task is `examples/tasks/cycle.py`. The first row is a script, the targets of the grips as they are. The others learn
what is added to these targets in each phase: the same for every cycle (phase), and a linear function of the joints'
deflections (joints) or of where the fingertips were last touched (touch), with the task's own settings for all three.
Each final policy is tried on 50 starts that were not used for training, for 1000 control steps (100 s), that is 83
cycles at most. Finished runs are not repeated; interrupted ones continue.
"""

import argparse
import statistics
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import learn, script

from farm import seeds as streams
from farm.arrays import FloatArray
from learner.again.replay import LoadedPolicy, load
from learner.run.config import configure
from learner.run.setup import problem

TASK: Final = f"{Path(__file__).parents[1] / 'examples/tasks/cycle.py'}:Cycle"
STARTS: Final = 50
STEPS: Final = 1000
WANTED: Final = 25


def main() -> None:
    """Learn, try, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=lambda text: list(map(int, text.split(","))), default=list(range(20, 25)))
    parser.add_argument("--states", type=lambda text: text.split(","), default=["touch", "joints", "phase"])
    parser.add_argument("--object", default="crowned-bar")
    parser.add_argument("--out", type=Path, default=Path("runs/cycles"))
    given = parser.parse_args()
    print(f"| what is seen | seed | cycles, least / median / most | starts with at least {WANTED} | never lost |")
    print("|---|---|---|---|---|")
    config = configure(TASK, state="phase", object=given.object, steps=STEPS)
    found = problem(config)
    print(f"| nothing: a script | - | {_row(LoadedPolicy(found, 0, np.zeros(found.policy.size)))} |", flush=True)
    for state in given.states:
        for seed in given.seeds:
            run = given.out / f"{given.object}-{state}-s{seed}"
            learn(configure(TASK, seed=seed, state=state, object=given.object), run, workers=2)
            print(f"| {state} | {seed} | {_row(load(run, steps=STEPS))} |", flush=True)


def _row(policy: LoadedPolicy) -> str:
    starts: list[Any] = [streams.trial(1, i) for i in range(STARTS)]
    rollouts = policy.runner.rollouts(np.repeat(policy.mu[None], STARTS, axis=0), starts)
    cycles: FloatArray = rollouts.measures[:, 0]
    told = f"{cycles.min():g} / {statistics.median(cycles):g} / {cycles.max():g}"
    return f"{told} | {(cycles >= WANTED).mean():.0%} | {(rollouts.steps == STEPS).mean():.0%}"


if __name__ == "__main__":
    script(main)
