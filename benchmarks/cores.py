"""A host's cores: a worker process for each, or one process with a thread for each; and what many
processes take.

    python benchmarks/cores.py [--cores 2,16,64] [--rollouts 30,200,2000] [--kind gait] [--hosts
        2,8,64]

First table: a chunk of R rollouts takes a process a + (b + c) R seconds, where a + b R is Python's
part and c R that of the physics, measured here on one core. With T threads the physics takes the
time of its longest thread, c ceil(R / T), and the rest is as long as before; that threads also wait
for each other at each step is left out. Learner and scheduler are the farm's own, network and
workers are emulated as in `large.py`, all on one host. The numbers are shares of what so many cores
could simulate: 1 is physics alone on each. Second table: `farm worker --workers N` here, forked
from one process or started one by one: memory, and time until all N are on the farm. `peers.py
--names pinned,pipes,loop` compares processes with and without cores of their own, and threads, on
two real cores.
"""

import argparse
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Final

from evaluations import evaluate, physics, theta
from large import measure
from peers import family

from farm.net import keys, session
from farm.net.session import free_endpoint

FEW, MANY, TURNS = 16, 60, 25
LATENCY: Final = 0.0003  # [s] of a message on one host
ONE_BY_ONE: Final = (
    "from farm import processes, __main__; processes._forks = lambda _: []; __main__.main()"
)


def main() -> None:
    """Measure, and print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cores", type=_numbers, default=[2, 16, 64])
    parser.add_argument("--rollouts", type=_numbers, default=[30, 200, 2000])
    parser.add_argument("--kind", choices=("gait", "arm"), default="gait")
    parser.add_argument("--hosts", type=_numbers, default=[2, 8, 64])
    arguments = parser.parse_args()
    fixed, python, steps = _parts(arguments.kind)
    print(
        f"a chunk of R rollouts: {1e3 * fixed:.1f} + ({1e3 * python:.2f} + {1e3 * steps:.2f}) R"
        " ms\n"
    )
    print(
        "| cores | rollouts | a process per core | one process, a thread per core |\n"
        "|---|---|---|---|"
    )
    for cores in arguments.cores:
        for rollouts in arguments.rollouts:
            one = _share(rollouts, cores, steps, lambda rows: fixed + (python + steps) * rows)
            threads = _share(
                rollouts,
                cores,
                steps,
                lambda rows, n=cores: fixed + python * rows + steps * math.ceil(rows / n),
                1,
            )
            print(f"| {cores} | {rollouts} | {one:.2f} | {threads:.2f} |", flush=True)
    print(
        "\n| processes | memory, forked [MB] | one by one [MB] | all joined, forked [s] | one by"
        " one [s] |"
    )
    print("|---|---|---|---|---|")
    for processes in arguments.hosts:
        (memory, seconds) = _host(processes, forked=True)
        (other, later) = _host(processes, forked=False)
        print(
            f"| {processes} | {memory:.0f} | {other:.0f} | {seconds:.1f} | {later:.1f} |",
            flush=True,
        )


def _numbers(text: str) -> list[int]:
    return [int(word) for word in text.split(",")]


def _parts(kind: str) -> tuple[float, float, float]:
    """Seconds of Python per chunk and per rollout, and of physics per rollout, by chunks of 16 and
    of 60.
    """
    python, fastest = [], []
    for count in FEW, MANY:
        rows, turns = theta(kind, count), []
        for _ in range(TURNS):
            times = [time.process_time()]
            for part in (partial(evaluate, kind, rows), partial(physics, kind, count, 1)):
                part()
                times.append(time.process_time())
            turns.append((times[1] - times[0], times[2] - times[1]))
        fastest.append(min(steps for _, steps in turns) / count)
        # The machine's speed varies, this does not
        ratio = statistics.median(whole / steps for whole, steps in turns)
        python.append((ratio - 1.0) * count)
    steps, each = min(fastest), max(0.0, (python[1] - python[0]) / (MANY - FEW))
    return steps * (python[0] - FEW * each), steps * each, steps


def _share(
    rollouts: int,
    cores: int,
    steps: float,
    seconds: Callable[[int], float],
    processes: int | None = None,
) -> float:
    """Share of a host's cores that simulate, in generations of so many rollouts."""
    took, _ = measure(processes or cores, rollouts // 2, LATENCY, 5.0, seconds)
    return rollouts * steps / cores / took


def _host(processes: int, *, forked: bool) -> tuple[float, float]:
    """Memory of `farm worker` [MB], and seconds until all its processes are on the farm."""
    program = ["-m", "farm"] if forked else ["-c", ONE_BY_ONE]
    endpoint = free_endpoint()
    with session.listen(endpoint, "farm") as link:
        count = 0
        start = time.perf_counter()
        command = [
            sys.executable,
            "-P",
            *program,
            "worker",
            "--connect",
            endpoint,
            "--workers",
            str(processes),
        ]
        host = subprocess.Popen([*command, "--log-level", "ERROR"])
        try:
            while count < processes:
                count = len(link.tokens(keys.worker_token("farm", "**"), 1.0))
                time.sleep(0.02)
            seconds = time.perf_counter() - start
            return family(host.pid)[1], seconds
        finally:
            host.terminate()
            host.wait()


if __name__ == "__main__":
    from running import script

    script(main)
