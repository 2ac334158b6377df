"""A run from Python: learn with two local workers, then read the summary.

    python examples/learn.py [--generations 60] [--out runs/example]

Any setting of `farm run` can be given by its name.
"""

import argparse
import json
import sys
from pathlib import Path

import farm


def main() -> None:
    """Learn, and print a line per generation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--generations", type=int, default=60)
    parser.add_argument("--out", type=Path, default=Path("runs/example"))
    arguments = parser.parse_args()

    config = farm.configure("finger-gait", seed=3, generations=arguments.generations, pairs=20)
    for report in farm.learn(config, arguments.out, workers=2):
        p = report.progress
        rate = f"{p.success_rate:4.0%}"
        print(f"{p.generation:4d}  mean policy {p.mean_policy_return:8.3f}  success {rate}")

    summary = json.loads((arguments.out / "summary.json").read_text("utf-8"))
    rate = f"{summary['robust_success_rate']:.0%}"
    print(f"{summary['state']}: robust success {rate} in {arguments.out}")


if __name__ == "__main__":
    try:
        main()
    except farm.FarmError as error:
        sys.exit(f"learn.py: {error}")
