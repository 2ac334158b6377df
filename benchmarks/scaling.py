"""How many workers a learner feeds: emulated ones, real in everything but physics; two tables.

    python benchmarks/scaling.py [--workers 1,4,16,64,256,1000] [--pair 0.02] [--seconds 12]

A worker is the farm's own `Worker` on a session of its own, whose backend sleeps instead of
simulating. A learner process learns from made-up returns. All share this machine, so the emulation
takes processor time that a real farm's learner would not have to share; the table has both. Beyond 64
workers a pair takes longer, so that there are not more pairs a second than at 64: what is measured
is then what so many workers cost, not so many rollouts.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from farm import session
from farm.arrays import FloatArray
from farm.commands.status import ask
from farm.jobs import Job
from farm.local import free_endpoint
from farm.messages import Spec
from farm.results import Result, WireTrajectory
from farm.scene import load
from workers.backends import BACKENDS
from workers.worker import Worker, WorkerConfig

TOGETHER = 32  # emulated workers a process
MOST = 3200  # pairs a second that are tried
PAIRS = 1000  # a generation; beyond 64 workers as many a worker as there
PARAMETERS = 64


class Sleeper:
    """A backend that takes its time for every job and makes its returns up."""

    capacity: ClassVar[int] = 64
    pair: ClassVar[float] = 0.02

    def __init__(self, spec: Spec) -> None:
        """Know the shapes that a learner expects."""
        self.steps, self.bodies = spec.task_config["steps"], len(load(spec.task_config["object"]).bodies)
        self.parameters = PARAMETERS
        self._mu: FloatArray | None = None
        self._until = 0.0

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Make results up, and sleep for what is left of the time that simulating would take.

        A round's further chunks begin where the one before ended: they lie ready, and what a dozen emulated workers
        on one core take to send their results must not delay them. Making up is done halfway, when the learner, whose
        cores these are, has least to do.
        """
        begin = self._until if mu is self._mu else time.monotonic()
        self._mu, self._until = mu, begin + self.pair * sum(len(job.signs) for job in jobs) / 2
        time.sleep(max(0.0, self._until - time.monotonic()) / 2)
        results = [self._result(job) for job in jobs]
        time.sleep(max(0.0, self._until - time.monotonic()))
        return results

    def close(self) -> None:
        """Nothing to give back."""

    def _result(self, job: Job) -> Result:
        count, no = len(job.signs), np.zeros(len(job.signs), dtype=bool)
        frames = self.steps * (10 if job.rate == "physics" else 1)
        return Result(
            index=job.index,
            trajectory=None if job.rate == "none" else self._trajectory(frames),
            returns=np.array([sign * job.eps.sum() if job.eps.size else 0.0 for sign in job.signs]),
            success=no, steps=np.full(count, self.steps), dropped=no, failed=no, clamped=no,
            traces=np.zeros((count, self.steps, 54), "<f4"),
        )  # fmt: skip

    def _trajectory(self, frames: int) -> WireTrajectory:
        shapes = {"bodies": (self.bodies, 7), "joints": (8,), "targets": (8,), "images": (3, 18), "points": (3, 3)}
        arrays = {name: np.zeros((frames + 1, *shape), "<f4") for name, shape in {**shapes, "terms": (5,)}.items()}
        return WireTrajectory(value=0.0, success=False, times=np.arange(frames + 1) * 0.1, **arrays)


@dataclass
class Measured:
    """One farm, while it worked."""

    joined: float
    pairs_per_second: float
    latency: float
    cpu: float
    """Of the learner, share of one core."""
    megabytes: float
    emulation: float
    """Processor time of all emulated workers, in cores."""


def main() -> None:
    """Measure and print; or be a process full of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", default="1,4,16,64,256,1000")
    parser.add_argument("--pair", type=float, default=0.02, help="what a pair takes [s]")
    parser.add_argument("--seconds", type=float, default=12.0, help="a farm is measured for so long")
    parser.add_argument("--emulate", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.emulate:
        _emulate(arguments.emulate[0], int(arguments.emulate[1]), arguments.pair)
        return
    counts = [int(word) for word in arguments.workers.split(",")]
    print(f"{len(os.sched_getaffinity(0))} cores, {platform.machine()}, Python {platform.python_version()}\n")
    print("| workers | ms a pair | N | all joined after [s] | rollouts/s | ideal | efficiency | learner: cores | "
          "us a pair | MB | emulation: cores |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for count in counts:
        pair, pairs = max(arguments.pair, count / MOST), max(PAIRS, PAIRS * count // 64)
        m, ideal = _measure(count, pairs, pair, arguments.seconds), 2 * count / pair
        print(
            f"| {count} | {pair * 1000:g} | {pairs} | {m.joined:.1f} | {2 * m.pairs_per_second:.0f} | {ideal:.0f} | "
            f"{2 * m.pairs_per_second / ideal:.2f} | {m.cpu:.2f} | {1e6 * m.cpu / m.pairs_per_second:.0f} | "
            f"{m.megabytes:.0f} | {m.emulation:.2f} |",
            flush=True,
        )
    print("\nA generation's time [ms], where simulating takes none (16 workers):\n")
    print("| N | median | us a pair, learner |\n|---|---|---|")
    for pairs in (15, 100, 1000):
        m = _measure(16, pairs, 0.0, arguments.seconds)
        print(f"| {pairs} | {1e3 * m.latency:.1f} | {1e6 * m.cpu / m.pairs_per_second:.0f} |", flush=True)


def _measure(workers: int, pairs: int, pair: float, seconds: float) -> Measured:
    """Let a farm of so many workers work for a while."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        endpoint, run = free_endpoint(), Path(folder, "runs/r")
        words = ["--listen", endpoint, "--name", "r", "--pairs", str(pairs), "--generations", "100000", "--no-record"]
        learner = stack.enter_context(_process(["-m", "farm", "learner", *words], folder))
        link = stack.enter_context(session.connect((endpoint,), 30.0, lambda: False))
        begun, emulators = time.monotonic(), []
        for first in range(0, workers, TOGETHER):
            count = min(TOGETHER, workers - first)
            command = [__file__, "--pair", str(pair), "--emulate", endpoint, str(count)]
            emulators.append(stack.enter_context(_process(command, folder)))
        while _present(link) < workers:
            time.sleep(0.05)
        joined = time.monotonic() - begun
        _wait(run, len(_progress(run)) + 2)
        first, cpu, start = len(_progress(run)), _cpu(learner.pid), time.monotonic()
        others = sum(_cpu(emulator.pid) for emulator in emulators)
        time.sleep(seconds)
        _wait(run, len(_progress(run)) + 1)
        lines, used, took = _progress(run), _cpu(learner.pid) - cpu, time.monotonic() - start
        times = [line["seconds"] for line in lines[first - 1 :]]
        over = (len(times) - 1) * pairs / (times[-1] - times[0])
        latency = statistics.median(b - a for a, b in zip(times, times[1:], strict=False))
        others = sum(_cpu(emulator.pid) for emulator in emulators) - others
        return Measured(joined, over, latency, used / took, _megabytes(learner.pid), others / took)


def _emulate(endpoint: str, workers: int, pair: float) -> None:
    """A process full of workers, until its standard input closes."""
    Sleeper.pair, over = pair, threading.Event()
    BACKENDS["sleeper"] = Sleeper
    with ExitStack() as stack:
        for i in range(workers):
            config = WorkerConfig(connect=(endpoint,), name=f"e{i}", backend="sleeper")
            link = stack.enter_context(session.connect(config.connect, None, over.is_set))
            thread = threading.Thread(target=_work, args=(Worker(config, link), over))
            stack.callback(thread.join)
            thread.start()
        sys.stdin.read()
        over.set()


def _work(worker: Worker, over: threading.Event) -> None:
    worker.join()
    while not over.is_set():
        worker.turn()


@contextmanager
def _process(words: list[str], folder: str) -> "Iterator[subprocess.Popen[bytes]]":
    with Path(folder, "said").open("ab") as said:
        process = subprocess.Popen(
            [sys.executable, *words], cwd=folder, stdin=subprocess.PIPE, stdout=said, stderr=said,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        try:
            yield process
        finally:
            if process.stdin:
                process.stdin.close()
            if words[0] == "-m":
                process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _present(link: session.Session) -> int:
    return sum(len(run.workers) for run in ask(link, "farm"))


def _progress(run: Path) -> list[dict[str, Any]]:
    path = run / "progress.jsonl"
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [json.loads(line) for line in lines]


def _wait(run: Path, generations: int) -> None:
    while len(_progress(run)) < generations:
        time.sleep(0.05)


def _cpu(pid: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _megabytes(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
