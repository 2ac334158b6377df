"""Measures how many workers one learner can serve, with emulated workers, which do not simulate.

Prints two tables.

    python benchmarks/scaling.py [--workers 1,4,16,64,256,1000] [--pair 0.02] [--seconds 12]

An emulated worker is the farm's `Worker` class with its own session. Instead of simulating, it
invents returns and sends them after the time that a simulation would take. A learner process learns
from them. Learner and emulation share this machine, which a real farm's learner would have for
itself; the table shows the processor time of both. With more than 64 workers a pair takes longer,
so that there are as many pairs per second as with 64. The table then shows the cost of more
workers, not of more rollouts.
"""

import argparse
import gc
import heapq
import itertools
import json
import os
import platform
import queue
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from farm.arrays import FloatArray
from farm.commands.status import ask
from farm.errors import Interrupted
from farm.net import codec, keys, session
from farm.net.events import Event, Events
from farm.net.messages import Spec
from farm.net.session import free_endpoint
from farm.net.work import Chunk, Failure, Jobs, Results, RoundHeader, Simulated, rows_with_trace
from farm.policies.base import Policy
from farm.runner import served
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.base import Task
from workers.config import WorkerConfig
from workers.worker import IDLE, Worker

TOGETHER = 32  # emulated workers per process
MOST = 3200  # largest number of pairs per second
PAIRS = 1000  # per generation; with more than 64 workers in proportion to their number
LOOK = 1.0  # [s] timeout of queries, and time between two idle checks


class MadeUp:
    """Does a run's jobs as `Runner` does, but invents the numbers, which takes no time."""

    def __init__(self, task: Task, policy: Policy) -> None:
        """Compute the shapes that the learner expects."""
        self.size, self.spec, self._parts = policy.size, policy.spec, task.substeps
        shapes = self.spec.shapes(len(Scene(task.model).bodies))
        self._plain = {
            name: shape for name, shape in shapes.items() if not name.startswith("channels/")
        }
        self._channels = {
            name[9:]: shape for name, shape in shapes.items() if name.startswith("channels/")
        }

    def run(
        self,
        mu: FloatArray,
        jobs: Jobs,
        traces: str = "none",
        _: FloatArray | None = None,
        **__: object,
    ) -> Simulated:
        """Invent results."""
        returns = jobs.theta(mu).sum(axis=1)
        exploring = ~np.repeat(jobs.seen, jobs.rollouts)
        rows = rows_with_trace(traces if self.spec.trace_channels else "none", returns, exploring)
        trajectories = tuple(
            self._trajectory(physics=bool(jobs.physics[job])) for job in np.flatnonzero(jobs.seen)
        )
        flags = np.zeros((len(returns), 4), dtype=bool)
        steps = np.full(len(returns), self.spec.steps)
        felt = np.zeros((len(rows), *self.spec.trace_shape), "<f4")
        return Simulated(
            returns=returns, flags=flags, steps=steps, traces=felt, trajectories=trajectories
        )

    def _trajectory(self, *, physics: bool) -> Trajectory:
        frames = self.spec.steps * (self._parts if physics else 1) + 1
        plain = {name: np.zeros((frames, *shape), "<f4") for name, shape in self._plain.items()}
        channels = {
            name: np.zeros((frames, *shape), "<f4") for name, shape in self._channels.items()
        }
        success = False if self.spec.success else None
        return Trajectory(
            value=0.0,
            success=success,
            times=0.1 * np.arange(frames, dtype=np.float64),
            channels=channels,
            **plain,
        )


class MadeUpRunners:
    """Instead of a worker's runners: one that makes up its numbers, shared by all workers of a
    process.
    """

    known: ClassVar[dict[str, MadeUp]] = {}
    """By the specification's digest."""

    def __init__(self, farm: str, link: session.Session) -> None:
        """Ask the learners of a farm for their specifications."""
        self._farm, self._link = farm, link

    def of(self, header: RoundHeader) -> MadeUp | None:
        """A run's runner; None if its learner does not answer."""
        if header.spec not in self.known:
            payload = self._link.ask(keys.spec(self._farm, header.run), LOOK)
            if payload is None:
                return None
            self.known[header.spec] = MadeUp(*served(codec.decode(payload, Spec)))
        return self.known[header.spec]

    def left(self, header: RoundHeader) -> None:
        """A learner left."""

    def close(self) -> None:
        """End."""


class Emulated(Worker):
    """A worker that answers when a real worker on its own core would.

    Its time is that of its pairs, and the processor time for reading jobs and writing results. The
    time that dozens of workers on one core wait for each other does not count, nor do sending and
    Zenoh's threads.
    """

    pair: ClassVar[float] = 0.02

    def __init__(self, config: WorkerConfig, link: session.Session, agenda: "Agenda") -> None:
        """Send results by this agenda."""
        super().__init__(config, link)
        self.runners = MadeUpRunners(config.farm, link)  # type: ignore[assignment]
        link.events = Noted(lambda: agenda.came.put((time.monotonic(), self)))
        self._agenda, self._until = agenda, 0.0
        self._arrived = self._cpu = 0.0

    def turn_at(self, arrived: float) -> None:
        """Make one turn for an event that arrived at this time [s]."""
        self._arrived, self._cpu = arrived, time.thread_time()
        self.turn()

    def _events(self) -> list[Event]:
        return sorted(self._session.events.waiting(0.0), key=lambda event: event.topic == "inbox")

    def _tell_idle(self) -> None:
        if time.monotonic() >= self._until + IDLE:  # until then it "simulates"
            super()._tell_idle()

    def _answer(self, chunk: Chunk, message: Results | Failure) -> None:
        if isinstance(message, Results):
            message = replace(message, seconds=0.0)  # the learner measures: inventing takes no time
        key, payload = keys.result(self._farm, chunk.run, self.id), codec.encode(message)
        took = self.pair * chunk.rollouts.sum() / 2 + time.thread_time() - self._cpu
        self._until = max(self._until, self._arrived) + took
        self._agenda.add(self._until, lambda: self._session.publish(key, payload))


class Noted(Events):
    """Events that call a function on arrival, except those that wake no thread."""

    def __init__(self, tell: Callable[[], None]) -> None:
        """Set the function to call."""
        super().__init__()
        self._tell = tell

    def put(self, event: Event, *, wake: bool = True, most: int | None = None) -> bool:
        """Append the event, and call the function."""
        result = super().put(event, wake=wake, most=most)
        if wake:
            self._tell()
        return result


class Agenda:
    """The work of all emulated workers in a process, on one thread: several would compete for the
    interpreter.
    """

    def __init__(self) -> None:
        self.came: queue.SimpleQueue[tuple[float, Emulated]] = queue.SimpleQueue()
        """Time of arrival of each event [s], and its worker"""
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()  # orders entries with the same time

    def add(self, at: float, send: Callable[[], None]) -> None:
        """Call a function at this time [s]."""
        heapq.heappush(self._due, (at, next(self._number), send))

    def follow(self, workers: Sequence[Emulated], over: threading.Event) -> None:
        """Run the workers."""
        look = 0.0
        while not over.is_set():
            now = time.monotonic()
            while self._due and self._due[0][0] <= now:
                heapq.heappop(self._due)[2]()
            if now >= look:
                look = now + LOOK
                for worker in workers:
                    worker.turn_at(time.monotonic())
            next_due = self._due[0][0] if self._due else look
            with suppress(queue.Empty):
                arrived, worker = self.came.get(
                    timeout=max(1e-6, min(look, next_due) - time.monotonic())
                )
                worker.turn_at(arrived)


@dataclass
class Measured:
    """Measurements of one farm."""

    joined: float
    pairs_per_second: float
    latency: float
    cpu: float
    """Processor time of the learner, in cores."""
    megabytes: float
    emulation: float
    """Processor time of all emulated workers, in cores."""


def main() -> None:
    """Measure and print; with --emulate, run a process of emulated workers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--workers", default="1,4,16,64,256,1000")
    parser.add_argument("--pair", type=float, default=0.02, help="duration of a pair [s]")
    parser.add_argument(
        "--seconds", type=float, default=12.0, help="duration of each measurement [s]"
    )
    parser.add_argument("--emulate", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.emulate:
        _emulate(arguments.emulate[0], int(arguments.emulate[1]), arguments.pair)
        return
    # Exit normally, so that child processes are stopped
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    counts = [int(word) for word in arguments.workers.split(",")]
    print(
        f"{len(os.sched_getaffinity(0))} cores, {platform.machine()}, Python"
        f" {platform.python_version()}\n"
    )
    print(
        "| workers | ms per pair | N | all joined after [s] | rollouts/s | ideal | efficiency |"
        " learner: cores | us per pair | MB | emulation: cores |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for count in counts:
        pair, pairs = max(arguments.pair, count / MOST), max(PAIRS, PAIRS * count // 64)
        m, ideal = measure(count, pairs, pair, arguments.seconds), 2 * count / pair
        print(
            f"| {count} | {pair * 1000:g} | {pairs} | {m.joined:.1f} | {2 * m.pairs_per_second:.0f}"
            f" | {ideal:.0f} | {2 * m.pairs_per_second / ideal:.2f} | {m.cpu:.2f} |"
            f" {1e6 * m.cpu / m.pairs_per_second:.0f} | {m.megabytes:.0f} | {m.emulation:.2f} |",
            flush=True,
        )
    print("\nTime per generation [ms] if simulation takes no time (16 workers):\n")
    print("| N | median | learner: us per pair |\n|---|---|---|")
    for pairs in (15, 100, 1000):
        m = measure(16, pairs, 0.0, arguments.seconds)
        print(
            f"| {pairs} | {1e3 * m.latency:.1f} | {1e6 * m.cpu / m.pairs_per_second:.0f} |",
            flush=True,
        )


def measure(workers: int, pairs: int, pair: float, seconds: float) -> Measured:
    """Measure a farm with this number of workers."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        endpoint, run = free_endpoint(), Path(folder, "runs/r")
        words = [
            "--listen",
            endpoint,
            "--name",
            "r",
            "--pairs",
            str(pairs),
            "--generations",
            "100000",
            "--no-record",
            "--audit",
            "0",  # the returns are made up
        ]
        learner = stack.enter_context(process(["-m", "farm", "learner", *words], folder))
        link = stack.enter_context(session.connect((endpoint,), 30.0, lambda: False))
        origin, emulators = time.monotonic(), []
        for first in range(0, workers, TOGETHER):
            count = min(TOGETHER, workers - first)
            command = [__file__, "--pair", str(pair), "--emulate", endpoint, str(count)]
            emulators.append(stack.enter_context(process(command, folder)))
        while _present(link) < workers:
            pause(learner, *emulators)
        arrival = time.monotonic() - origin
        _wait(run, len(progress(run)) + 2, learner, *emulators)
        first, before, start = len(progress(run)), cpu(learner.pid), time.monotonic()
        others = sum(cpu(emulator.pid) for emulator in emulators)
        time.sleep(seconds)
        _wait(run, len(progress(run)) + 1, learner, *emulators)
        lines = progress(run)
        cpu_seconds = cpu(learner.pid) - before
        took = time.monotonic() - start
        times = [line["seconds"] for line in lines[first - 1 :]]
        over = (len(times) - 1) * pairs / (times[-1] - times[0])
        latency = statistics.median(b - a for a, b in zip(times, times[1:], strict=False))
        others = sum(cpu(emulator.pid) for emulator in emulators) - others
        return Measured(
            arrival, over, latency, cpu_seconds / took, megabytes(learner.pid), others / took
        )


def _emulate(endpoint: str, workers: int, pair: float) -> None:
    """Run a process of emulated workers until its standard input closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # on Ctrl-C the parent process stops this one
    Emulated.pair, over, agenda = pair, threading.Event(), Agenda()
    threading.Thread(target=_until_closed, args=(over,), daemon=True).start()
    with suppress(Interrupted), ExitStack() as stack:
        emulated: list[Emulated] = []
        for i in range(workers):
            config = WorkerConfig(connect=(endpoint,), name=f"e{i}")
            link = stack.enter_context(session.connect(config.connect, None, over.is_set))
            emulated.append(Emulated(config, link, agenda))
            emulated[-1].join()
        gc.freeze()  # otherwise garbage collection would search the many objects of all workers
        agenda.follow(emulated, over)


def _until_closed(over: threading.Event) -> None:
    sys.stdin.read()
    over.set()


@contextmanager
def process(words: list[str], folder: str) -> "Iterator[subprocess.Popen[bytes]]":
    """A Python process that is stopped at the end of the block."""
    with Path(folder, "said").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, *words],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
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


def progress(run: Path) -> list[dict[str, Any]]:
    """A run's generations so far."""
    path = run / "progress.jsonl"
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [json.loads(line) for line in lines]


def _wait(run: Path, generations: int, *processes: "subprocess.Popen[bytes]") -> None:
    while len(progress(run)) < generations:
        pause(*processes)


def pause(*processes: "subprocess.Popen[bytes]") -> None:
    """Wait a moment; exit if one of the processes has ended."""
    time.sleep(0.05)
    if any(process.poll() is not None for process in processes):
        sys.exit("a learner or a process with emulated workers ended too early")


def cpu(pid: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def megabytes(pid: int) -> float:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    from running import script

    script(main)
