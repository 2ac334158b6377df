"""A farm under unusual loads: many learners, idle workers, huge and tiny generations; one table.

    python benchmarks/load.py [--seconds 10] [--learners 40]

The workers are emulated on this machine, as in scaling.py; their rollouts take no time.
"""

import argparse
import signal
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from scaling import __file__ as emulator
from scaling import cpu, measure, megabytes, pause, process, progress

from farm.net.session import free_endpoint


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--learners", type=int, default=40)
    arguments = parser.parse_args()
    # Exit normally, so that child processes are stopped
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    print(
        "| load | generations/s | rollouts/s | time per generation [ms] | learner: cores | learner"
        " MB |"
    )
    print("|---|---|---|---|---|---|")
    for what, workers, pairs in (
        ("one pair per generation, 1 worker", 1, 1),
        ("20 000 pairs per generation, 16 workers", 16, 20_000),
        ("200 workers, one pair per generation", 200, 1),
    ):
        m = measure(workers, pairs, 0.0, arguments.seconds)
        rate = m.pairs_per_second / pairs
        figures = (
            f"{rate:.1f} | {2 * m.pairs_per_second:.0f} | {1e3 * m.latency:.1f} | {m.cpu:.2f} |"
            f" {m.megabytes:.0f}"
        )
        print(f"| {what} | {figures} |", flush=True)
    _learners(arguments.learners, arguments.seconds)


def _learners(count: int, seconds: float) -> None:
    """Measure this number of learners behind one router, with four workers that serve all of
    them.
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        endpoint, generations = free_endpoint(), 20
        router = stack.enter_context(
            process(["-m", "farm", "router", "--listen", endpoint], folder)
        )
        workers = stack.enter_context(
            process([emulator, "--pair", "0", "--emulate", endpoint, "4"], folder)
        )
        words = ["-m", "farm", "learner", "--connect", endpoint, "--no-record", "--pairs", "15"]
        words += ["--generations", str(generations), "--audit", "0"]  # the returns are made up
        start = time.monotonic()
        learners = [
            stack.enter_context(process([*words, "--name", f"r{i}"], folder)) for i in range(count)
        ]
        runs = [Path(folder, f"runs/r{i}") for i in range(count)]
        most = 0.0
        while any(len(progress(run)) < generations for run in runs):
            most = max(
                most, *(megabytes(each.pid) for each in learners if each.poll() is None), 0.0
            )
            if time.monotonic() - start > 60 * seconds:
                sys.exit(
                    f"{sum(len(progress(run)) for run in runs)} of {count * generations}"
                    " generations were done"
                )
            pause(router, workers)
        took = time.monotonic() - start
        print(
            f"| {count} learners behind a router, 4 workers | {count * generations / took:.1f} | "
            f"{30 * count * generations / took:.0f} | - | router: {cpu(router.pid) / took:.2f} | "
            f"{most:.0f}, router {megabytes(router.pid):.0f} |"
        )


if __name__ == "__main__":
    from running import script

    script(main)
