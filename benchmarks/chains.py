"""Learns four gaits, runs them in turn, and counts the cycles until the bar is lost; one table.

    python benchmarks/chains.py [--seeds 20,21,22,23,24] [--policy constant] [--out runs/chains]

The gaits are the presets middle-on, index-off, index-on and middle-off. For each gait the table has
the number of rollouts after which the mean policy succeeds on at least 95 of 100 perturbed starts,
in this test and all later ones. The tests are after every generation of the first 200 rollouts, and
at the end. The chain is tried on 50 different starts for 1000 control steps (100 s). Finished runs
are not repeated; interrupted ones continue.
"""

import argparse
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import learn

from farm import seeds
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.tools.chain.chain import Chained, chain
from learner.tools.replay.loaded import LoadedPolicy, load

GAITS: Final = ("middle-on", "index-off", "index-on", "middle-off")
SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "weighted-kernel": {"generations": 25},
    "constant": {"policy": "constant", "initial_sigma": 0.2, "generations": 80},
}
"""Settings that differ from the presets, by policy: 500 or 1600 rollouts per gait."""
TRIALS: Final = 100
ENOUGH: Final = 95  # successes required
FIRST: Final = 200  # rollouts during which the mean policy is tested after each generation
STARTS: Final = 50
STEPS: Final = 1000


def main() -> None:
    """Learn, chain, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="20,21,22,23,24")
    parser.add_argument("--policy", choices=tuple(SETTINGS), default="constant")
    parser.add_argument("--out", type=Path, default=Path("runs/chains"))
    arguments = parser.parse_args()
    print(
        f"| seed | {' | '.join(GAITS)} | cycles, least / median / most | starts with at least 10,"
        " 25 |"
    )
    print(f"|---|{'---|' * len(GAITS)}---|---|")
    for seed in map(int, arguments.seeds.split(",")):
        runs = [arguments.out / f"{arguments.policy}-{gait}-s{seed}" for gait in GAITS]
        for gait, run in zip(GAITS, runs, strict=True):
            learn(
                configure("finger-gait", gait, seed=seed, **SETTINGS[arguments.policy]),
                run,
                workers=2,
            )
        policies = [load(run) for run in runs]
        since = " | ".join(_since(run, policy) for run, policy in zip(runs, policies, strict=True))
        result = chain(policies, [seeds.evaluation_start(1, i) for i in range(STARTS)], STEPS)
        cycles = result.changes // len(GAITS)
        _keep(arguments.out / f"{arguments.policy}-s{seed}.json", result)
        print(
            f"| {seed} | {since} | {cycles.min()} / {np.median(cycles):g} / {cycles.max()} "
            f"| {(cycles >= 10).mean():.0%}, {(cycles >= 25).mean():.0%} |",
            flush=True,
        )


def _since(run: Path, policy: LoadedPolicy) -> str:
    """Number of rollouts from which on every tested mean policy is robust."""
    folder, robust = RunFolder.open(run), []
    progress = [
        line
        for line in folder.progress()
        if line.rollouts <= FIRST or line.generation == policy.generation
    ]
    starts = [seeds.evaluation_start(0, i) for i in range(TRIALS)]
    for line in progress:
        mu, _ = folder.parameters.mean(line.generation)
        rollouts = policy.runner.rollouts(np.repeat(mu[None], TRIALS, axis=0), starts)
        robust.append(int(rollouts.success.sum()))
    below = [at for at, good in enumerate(robust) if good < ENOUGH]
    first = below[-1] + 1 if below else 0
    return (
        f"{progress[first].rollouts} ({robust[-1]} %)"
        if first < len(progress)
        else f"- ({robust[-1]} %)"
    )


def _keep(path: Path, result: Chained) -> None:
    contents = {"changes": result.changes.tolist(), "starts": STARTS, "steps": STEPS}
    path.write_text(json.dumps(contents) + "\n", "utf-8")


if __name__ == "__main__":
    from running import script

    script(main)
