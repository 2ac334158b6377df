"""Shows what learner and workers do, and when they wait: a picture of two generations, and a table
of times.

    python benchmarks/timeline.py [--pairs 15] [--generations 60] [--picture FILE.svg]

A learner with two local workers learns the gait. Learner and workers record the begin and end of
each of their tasks, by the same clock. The picture shows two generations of median duration.
"""

import argparse
import json
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from farm import configure
from farm.net import session
from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.launch import open_run
from workers.config import WorkerConfig
from workers.worker import Worker

PARTS: Final = {
    "simulate": "#009e73",
    "send results": "#e69f00",
    "hand out jobs": "#56b4e9",
    "take results": "#0072b2",
    "update, save, report": "#cc79a7",
}

Noted = list[tuple[str, float, float]]
"""Name, begin and end [s] of each task."""


def noting(noted: Noted, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which then also records its begin and end."""

    def run(*words: Any, **more: Any) -> Any:  # noqa: ANN401
        start = time.monotonic()
        try:
            return function(*words, **more)
        finally:
            noted.append((part, start, time.monotonic()))

    return run


def work(endpoint: str) -> None:
    """Work until standard input closes; then print the noted times."""
    # On Ctrl-C the learner's process closes standard input
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    noted: Noted = []
    with session.connect((endpoint,), 30.0, lambda: False) as link:
        worker = Worker(WorkerConfig(connect=(endpoint,)), link)
        worker._do = noting(noted, "simulate", worker._do)  # type: ignore[method-assign]
        worker._answer = noting(noted, "send results", worker._answer)  # type: ignore[method-assign]
        worker.join()
        sys.stdin.readline()  # wait until the learner listens to results
        while not _closed():
            worker.turn()
        worker.close()
    print(json.dumps(noted))


def _closed() -> bool:
    return bool(select.select([sys.stdin], [], [], 0.0)[0])


def main() -> None:
    """Learn, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--generations", type=int, default=60)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.work)
        return
    rounds, rows = measure(arguments.pairs, arguments.generations)
    middle = rounds[len(rounds) // 3 :]
    lengths = [b - a for a, b in zip(middle, middle[1:], strict=False)]
    length = statistics.median(lengths)
    print(
        f"{1e3 * length:.1f} ms per generation of {arguments.pairs} pairs (median of"
        f" {len(lengths)})\n"
    )
    print("| task | ms per generation, learner and both workers |\n|---|---|")
    took = {
        part: (
            1e3
            * sum(
                e - b
                for noted in rows
                for name, b, e in noted
                if name == part and middle[0] <= b < middle[-1]
            )
        )
        for part in PARTS
    }
    # The next jobs are handed out in the middle of the update
    took["update, save, report"] -= took["hand out jobs"]
    took["simulate"] -= took["send results"]  # results are sent at its end
    for part, total in took.items():
        print(f"| {part} | {total / len(lengths):.1f} |")
    print(
        "| both workers wait |"
        f" {2e3 * length - (took['simulate'] + took['send results']) / len(lengths):.1f} |"
    )
    if arguments.picture:
        at = min(range(len(middle) - 2), key=lambda i: abs(middle[i + 2] - middle[i] - 2 * length))
        draw(rows, middle[at] - 0.002, middle[at + 2] + 0.002, arguments.picture)


def measure(pairs: int, generations: int) -> tuple[list[float], list[Noted]]:
    """When each round began, and what learner and workers recorded."""
    config = configure(pairs=pairs, generations=generations)
    endpoint, rounds = free_endpoint(), list[float]()
    learner: Noted = []
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = stack.enter_context(
            open_run(config, Path(folder, "r"), Placement(workers=0, listen=endpoint))
        )
        begin = run.pool.begin
        collect = run.pool.collect
        take = run.pool._take

        def begin_round(*words: Any, **more: Any) -> None:  # noqa: ANN401
            rounds.append(time.monotonic())
            begin(*words, **more)

        run.pool.begin = noting(learner, "hand out jobs", begin_round)  # type: ignore[method-assign]
        run.pool._take = noting(learner, "take results", take)  # type: ignore[method-assign]
        last = [0.0]

        def collected() -> Any:  # noqa: ANN401
            if last[0]:
                learner.append(("update, save, report", last[0], time.monotonic()))
            results = collect()
            last[0] = time.monotonic()
            return results

        run.pool.collect = collected  # type: ignore[method-assign]
        command = [sys.executable, __file__, "--work", endpoint]
        pipe = subprocess.PIPE
        workers = [subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) for _ in range(2)]
        try:
            for worker in workers:
                assert worker.stdin is not None
                worker.stdin.write("\n")
                worker.stdin.flush()
            while len(run.pool.workers) < 2:
                for event in run.pool._events():
                    take(event)
            for _ in run.learner.learn(run.pool):
                pass
        finally:
            outputs = [worker.communicate("\n")[0] for worker in workers]
    return rounds, [learner, *(json.loads(text) for text in outputs)]


def draw(rows: list[Noted], start: float, end: float, path: Path) -> None:
    """Draw bars over time, for learner and workers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.6), layout="constrained")
    axes = figure.subplots()
    for height, noted in enumerate(rows):
        # Handing out jobs is part of the learner's update, and drawn on top of it
        order = sorted(noted, key=lambda one: one[0] == "hand out jobs")
        for part, first, last in order:
            if last > start and first < end:
                axes.barh(
                    -height,
                    1e3 * (last - first),
                    left=1e3 * (first - start),
                    height=0.7,
                    color=PARTS[part],
                )
    for part, colour in PARTS.items():
        axes.barh(0, 0, color=colour, label=part)
    axes.set_yticks([0, -1, -2], ["learner", "worker 1", "worker 2"])
    axes.set_xlim(0, 1e3 * (end - start))
    axes.set_xlabel("time [ms]; blank: waiting")
    axes.legend(ncols=5, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    from running import script

    script(main)
