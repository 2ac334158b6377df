"""Learns the robots of examples/robots with the commands of their files, five seeds each; one
table.

    python benchmarks/robots.py [--only go1,crazyflie] [--seeds 0,1,2,3,4] [--runs runs/robots]

All figures are from 100 starts that no learning has seen, those of `farm evaluate`: the mean return
beside doing nothing and the best of 32 constant actions, how many rollouts end early, and the
task's measures. Seconds are those of the whole run with two local workers; compare them only on an
idle machine. Runs that are there are not repeated.
"""

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import script

from learner.run.evaluation import evaluation_jobs
from learner.tools.replay.loaded import load

ROBOTS: Final = {
    "go1": "go1.py:Walk --generations 60",
    "rough": "go1.py:Rough --generations 60",
    "crazyflie": "crazyflie.py:Hover",
    "ur5e": "ur5e.py:Push",
    "leap": "leap.py:Turn --generations 60 --policy linear --algorithm snes --initial-sigma 0.5",
}
"""Task and flags of each."""

STARTS: Final = 100
FOLDER: Final = Path(__file__).parents[1] / "examples/robots"


def main() -> None:
    """Learn what is missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default=",".join(ROBOTS))
    parser.add_argument("--seeds", default="0,1,2,3,4")
    parser.add_argument("--runs", type=Path, default=Path("runs/robots"))
    arguments = parser.parse_args()
    print(
        "| robot | seed | learnt | nothing | constant | end early | measures | rollouts | seconds |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in arguments.only.split(","):
        for seed in arguments.seeds.split(","):
            print(row(name, seed, arguments.runs / f"{name}-s{seed}"), flush=True)


def row(name: str, seed: str, run: Path) -> str:
    """A robot's row for a seed."""
    if not (run / "summary.json").exists():
        task, *flags = shlex.split(ROBOTS[name])
        words = [
            "run",
            "--task",
            str(FOLDER / task),
            *flags,
            "--seed",
            seed,
            "--no-record",
            "--quiet",
        ]
        place = ["--out", str(run.parent), "--name", run.name]
        subprocess.run(
            [sys.executable, "-m", "farm", *words, *place], check=True, stdout=subprocess.DEVNULL
        )
    summary = json.loads((run / "summary.json").read_text())
    others = summary["without_learning"]
    cells = [
        name,
        seed,
        f"{summary['robust_score']:.3g}",
        *(f"{others[each]['score']:.3g}" for each in ("nothing", "constant")),
        f"{ended(run)} of {STARTS}",
        measures(summary["robust_measures"]),
        str(summary["rollouts"]),
        f"{summary['seconds']:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def ended(run: Path) -> int:
    """How many rollouts from the starts end early, or fail."""
    policy = load(run)
    results = policy.runner.run(policy.mu, evaluation_jobs(STARTS, 0))
    return int(np.count_nonzero(results.flags[:STARTS, 1:].any(axis=1)))


def measures(values: dict[str, Any]) -> str:
    """Measures as text."""
    return ", ".join(f"{name} {value:.3g}" for name, value in values.items())


if __name__ == "__main__":
    script(main)
