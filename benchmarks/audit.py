"""Measures the cost of spot checks: rollouts/s of two hosts, in turn without and with checks; one table.

    python benchmarks/audit.py [--generations 60] [--repeats 5]

Two workers with different host names on this machine learn the finger gait as `farm run` does, without recording.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from farm.net.session import free_endpoint
from farm.processes import LocalWorkers
from learner.run.config import RunConfig, configure
from learner.run.launch import Placement, open_run
from learner.scheduler.scheduler import SchedulerConfig

AUDITS = (0.0, 0.02, 0.1)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generations", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print("| pairs | --audit | rollouts/s | ratio to no checks |\n|---|---|---|---|")
    for pairs in (15, 100):
        config = configure(pairs=pairs, generations=max(10, arguments.generations * 15 // pairs))
        rates = np.array([[_rate(config, audit) for audit in AUDITS] for _ in range(arguments.repeats)])
        for audit, column in zip(AUDITS, rates.T, strict=True):
            print(
                f"| {pairs} | {audit:g} | {np.median(column):.0f} | {np.median(column / rates[:, 0]):.3f} |", flush=True
            )


def _rate(config: RunConfig, audit: float) -> float:
    """Exploring rollouts per second, without the first tenth of the generations."""
    place = Placement(listen=free_endpoint(), record=False, scheduler=SchedulerConfig(audit=audit))
    flags = ["--connect", place.listen, "--log-level", "WARNING"]
    times: list[float] = []
    with tempfile.TemporaryDirectory() as folder, open_run(config, Path(folder) / "run", place) as run:
        with (
            LocalWorkers(1, [*flags, "--name", "a"], dict(os.environ)),
            LocalWorkers(1, [*flags, "--name", "b"], dict(os.environ)),
        ):
            for report in run.learn():
                times.append(time.perf_counter())
                last = report.progress
    begun = len(times) // 10
    done = last.rollouts / last.generation * (len(times) - 1 - begun)
    return done / (times[-1] - times[begun])


if __name__ == "__main__":
    from running import script

    script(main)
