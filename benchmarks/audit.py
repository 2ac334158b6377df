"""Measures the cost of spot checks: rollouts/s of two hosts, in turn without and with checks; one
table.

    python benchmarks/audit.py [--repeats 3]

Two workers with different host names on this machine learn the finger gait as `farm run` does,
without recording. The rate is that of the generations until both hosts have passed 240 checks, and
of as many after them.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from farm.net.session import free_endpoint
from farm.processes import LocalWorkers
from learner.run.config import RunConfig, configure
from learner.run.launch import Placement, open_run
from learner.scheduler.scheduler import SchedulerConfig

EARNED = 240  # checks that a host passes before it counts as known: `learner.scheduler.audit`


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print(
        "| pairs | hosts | checks per generation | rollouts/s | ratio to no checks |\n"
        "|---|---|---|---|---|"
    )
    for pairs in (15, 100):
        turns: dict[str, list[tuple[float, float]]] = {"without checks": [], "new": [], "known": []}
        for _ in range(arguments.repeats):
            times, checks = _learnt(configure(pairs=pairs, generations=10_000), 0.02, math.inf)
            new = next(at for at, count in enumerate(checks) if count >= EARNED)
            without, _ = _learnt(configure(pairs=pairs, generations=new), 0.0, new)
            turns["without checks"].append((_rate(without), 0.0))
            turns["new"].append((_rate(times[: new + 1]), checks[new] / new))
            turns["known"].append((_rate(times[new:]), (checks[-1] - checks[new]) / new))
        base = np.array(turns["without checks"])[:, 0]
        for what, column in turns.items():
            rates, each = np.array(column).T
            figures = (
                f"{2 * np.median(each):.1f} | {2 * pairs * np.median(rates):.0f} |"
                f" {np.median(rates / base):.3f}"
            )
            print(f"| {pairs} | {what} | {figures} |", flush=True)


def _rate(times: Sequence[float]) -> float:
    """Generations per second, without the first ones."""
    first = len(times) // 10 + 1
    return (len(times) - 1 - first) / (times[-1] - times[first])


def _learnt(config: RunConfig, audit: float, most: float) -> tuple[list[float], list[int]]:
    """The time after each generation [s], and how many checks the host with the fewest had passed
    by then.

    The run ends when it has learnt as many generations with known hosts as with new ones, or this
    number.
    """
    place = Placement(listen=free_endpoint(), record=False, scheduler=SchedulerConfig(audit=audit))
    flags = ["--connect", place.listen, "--log-level", "WARNING"]
    times, checks, warmup = list[float](), list[int](), 0
    with (
        tempfile.TemporaryDirectory() as folder,
        open_run(config, Path(folder) / "run", place) as run,
    ):
        with (
            LocalWorkers(1, [*flags, "--name", "a"]),
            LocalWorkers(1, [*flags, "--name", "b"]),
        ):
            for _ in run.learn():
                times.append(time.perf_counter())
                checks.append(min(run.dispatcher.checks.values(), default=0))
                warmup = warmup or (len(times) if checks[-1] >= EARNED else 0)
                if len(times) == (2 * warmup or most):
                    break
    return times, checks


if __name__ == "__main__":
    from running import script

    script(main)
