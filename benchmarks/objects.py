"""Learns one policy for several objects, and tries it on each object and on ones that it was not
trained on; one table.

    python benchmarks/objects.py [--seeds 0,1,2] [--generations 90] [--pose opposed]
        [--out runs/objects]
    python benchmarks/objects.py --unseen [--seeds 20,21,22,23,24]

For each set of objects that the gait is trained on: success on 200 perturbed starts with each of
five objects, one number for each seed. With --unseen, every policy is trained on all five, each
with different observations, and one with none; three more objects, which it never met, follow, and
the mean over these. Finished runs are not repeated; interrupted ones continue.
"""

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import learn, numbers, script

from farm.arrays import FloatArray
from learner.run.config import configure
from learner.run.evaluation import evaluation_jobs
from learner.tools.replay.loaded import load

OBJECTS: Final = ("bar", "thin-bar", "thick-bar", "cylinder", "bolt")
UNSEEN: Final = ("hexagon", "stepped-bar", "club")
TRAINED: Final = (("bar",), ("cylinder",), ("bar", "thick-bar", "cylinder"), OBJECTS)
SEES: Final[dict[str, dict[str, Any]]] = {
    "joints": {"state": "joints"},
    "forces": {"state": "forces"},
    "contact points": {"state": "cop"},
    "tactile image": {"state": "tactile"},
    "nothing": {"policy": "constant", "state": "joints", "initial_mu": 0.0, "initial_sigma": 0.1},
}
STARTS: Final = 200


def main() -> None:
    """Learn, try, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=numbers)
    parser.add_argument("--generations", type=int, default=90)
    parser.add_argument("--pose", default="opposed")
    parser.add_argument("--out", type=Path, default=Path("runs/objects"))
    parser.add_argument(
        "--unseen", action="store_true", help="policies with different observations"
    )
    arguments = parser.parse_args()
    settings = {"generations": arguments.generations, "pose": arguments.pose}
    (unseen if arguments.unseen else sets)(
        arguments.seeds or list(range(20, 25) if arguments.unseen else range(3)),
        arguments.out,
        settings,
    )


def sets(seeds: Sequence[int], out: Path, settings: dict[str, Any]) -> None:
    """The table of sets of objects."""
    print(f"| trained on | {' | '.join(OBJECTS)} |")
    print(f"|---|{'---|' * len(OBJECTS)}")
    for trained in TRAINED:
        shares = _tried(seeds, OBJECTS, out, {**settings, "object": trained}, "-".join(trained))
        cells = [", ".join(f"{share:g}" for share in each) for each in shares.T]
        print(f"| {', '.join(trained)} | {' | '.join(cells)} |", flush=True)


def unseen(seeds: Sequence[int], out: Path, settings: dict[str, Any]) -> None:
    """The table of observations."""
    heads = [*OBJECTS, "their mean", *UNSEEN, "their mean"]
    print(f"| the policy sees | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}")
    for name, sees in SEES.items():
        shares = _tried(
            seeds, (*OBJECTS, *UNSEEN), out, {**settings, "object": OBJECTS, **sees}, name
        )
        parts = shares[:, : len(OBJECTS)], shares[:, len(OBJECTS) :]
        cells = [
            cell
            for part in parts
            for cell in (*map(_cell, part.T), f"**{_cell(part.mean(axis=1))}**")
        ]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _tried(
    seeds: Sequence[int], things: Sequence[str], out: Path, settings: dict[str, Any], name: str
) -> FloatArray:
    """Success with each object [%], (seeds, objects), of policies that are learnt with settings."""
    rows = []
    for seed in seeds:
        run = out / f"{settings['pose']}-{settings['generations']}-{name.replace(' ', '-')}-s{seed}"
        learn(configure("finger-gait", seed=seed, **settings), run, workers=2)
        rows.append([_success(run, thing) for thing in things])
    return np.array(rows)


def _success(run: Path, thing: str) -> float:
    policy = load(run, object=thing)
    results = policy.runner.run(policy.mu, evaluation_jobs(STARTS, 1))
    return 100.0 * float(results.flags[:STARTS, 0].mean())


def _cell(values: FloatArray) -> str:
    return f"{statistics.median(values):.3g} ({values.min():.3g} to {values.max():.3g})"


if __name__ == "__main__":
    script(main)
