"""Learns one policy for several objects, and tries it on each object and on ones that it was not trained on; one table.

    python benchmarks/objects.py [--seeds 0,1,2] [--generations 90] [--pose opposed] [--out runs/objects]

For each set of objects that the gait is trained on: success on 200 perturbed starts with each of five objects, one
number for each seed. Finished runs are not repeated; interrupted ones continue.
"""

import argparse
from pathlib import Path
from typing import Final

from running import learn

from learner.again.replay import load
from learner.run.config import configure
from learner.run.evaluation import evaluation_jobs

OBJECTS: Final = ("bar", "thin-bar", "thick-bar", "cylinder", "bolt")
TRAINED: Final = (("bar",), ("cylinder",), ("bar", "thick-bar", "cylinder"), OBJECTS)
STARTS: Final = 200


def main() -> None:
    """Learn, try, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--generations", type=int, default=90)
    parser.add_argument("--pose", default="opposed")
    parser.add_argument("--out", type=Path, default=Path("runs/objects"))
    given = parser.parse_args()
    print(f"| trained on | {' | '.join(OBJECTS)} |")
    print(f"|---|{'---|' * len(OBJECTS)}")
    for trained in TRAINED:
        runs = []
        for seed in map(int, given.seeds.split(",")):
            run = given.out / f"{given.pose}-{given.generations}-{'-'.join(trained)}-s{seed}"
            own = {"generations": given.generations, "pose": given.pose, "object": trained, "seed": seed}
            learn(configure("finger-gait", **own), run, workers=2)
            runs.append(run)
        told = [", ".join(_success(run, thing) for run in runs) for thing in OBJECTS]
        print(f"| {', '.join(trained)} | {' | '.join(told)} |", flush=True)


def _success(run: Path, thing: str) -> str:
    """Success of a learnt policy with an object [%]."""
    policy = load(run, object=thing)
    found = policy.runner.run(policy.mu, evaluation_jobs(STARTS, 1))
    return f"{100.0 * found.flags[:STARTS, 0].mean():g}"


if __name__ == "__main__":
    main()
