"""Measures the learner alone, as part of a large farm: its processor time, and how long workers
wait for it.

    python benchmarks/large.py [--workers 64,256,1000] [--pair 0.02] [--latency 0.0003] [--seconds
        20]

Learner and scheduler are the farm's own. Network and workers are simulated: each worker does one
chunk at a time, in the time of its pairs, and each message takes the latency. The clock is virtual:
it advances by the processor time of the learner's thread, and to the next message if the learner
waits. So the workers take no time from the learner, as in a farm whose learner has a core of its
own. Zenoh's threads are missing; `scaling.py` includes them.
"""

import argparse
import heapq
import itertools
import operator
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import scaling

from farm.net import codec, keys, session
from farm.net.events import Event
from farm.net.messages import WorkRequest
from farm.net.rates import Rates
from farm.net.work import Chunk, Results
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run import setup
from learner.run.config import RunConfig, configure
from learner.run.launch import open_run

FARM = Placement().farm
NO_CHECKS = SchedulerConfig(audit=0.0)  # the returns are made up
CREDITS = 400  # of a worker, in jobs
FIRST = 3  # generations that are not measured: jobs have no known duration at first


class Silent:
    """A publisher without subscribers."""

    heard = False


class Network:
    """A session whose messages travel in virtual time, and the workers at its other end."""

    dropped = 0

    def __init__(
        self,
        config: RunConfig,
        workers: int,
        latency: float,
        duration: Callable[[int], float],
    ) -> None:
        """Let all workers ask for work; `duration` is that of a chunk with a number of rollouts
        [s].
        """
        problem = setup.problem(config)
        self._work = scaling.MadeUp(problem.task, problem.policy)
        self._mu, self._traces = np.zeros(problem.policy.size), config.traces
        self._duration, self._latency = duration, latency
        self.events, self.rates = self, Rates()
        self._begun = time.thread_time()
        self._waited = 0.0
        self._other = 0.0  # processor time that is not the learner's [s]
        self._due: list[tuple[float, int, Event]] = []
        self._number = itertools.count()  # orders messages with the same time
        # The time at which each has done its chunks
        self._free = {f"host-{i}/1": 0.0 for i in range(workers)}
        for name in self._free:
            want = WorkRequest(
                worker=name,
                credits=CREDITS,
                idle=(),
                version="0",
                fingerprint="c",
                host=name,
                cores=1,
            )
            self._send(0.0, Event("worker", keys.worker_token(FARM, name), b""))
            self._send(0.0, Event("want", keys.want(FARM, name), codec.encode(want)))

    def now(self) -> float:
        """Virtual time [s]."""
        return self._waited + self.busy

    @property
    def busy(self) -> float:
        """Processor time of the learner's thread [s]."""
        return time.thread_time() - self._begun - self._other

    @contextmanager
    def _apart(self) -> Iterator[float]:
        """The block is not the learner's work; yields the time at which it begins."""
        start, now = time.thread_time(), self.now()
        yield now
        self._other += time.thread_time() - start

    def _send(self, at: float, event: Event) -> None:
        heapq.heappush(self._due, (at, next(self._number), event))

    def waiting(self, timeout: float) -> list[Event]:
        """Messages that have arrived, as `Events` gives them."""
        with self._apart() as now:
            wait = max(0.0, min(timeout, self._due[0][0] - now if self._due else timeout))
            self._waited, now, events = self._waited + wait, now + wait, []
            while self._due and self._due[0][0] <= now:
                events.append(heapq.heappop(self._due)[2])
        return events

    def publish(self, key: str, payload: bytes, **_: Any) -> None:  # noqa: ANN401
        """Deliver a chunk to its worker, and send its results when the worker has done it."""
        with self._apart() as now:
            name = key.removeprefix(keys.inbox(FARM, ""))
            if name not in self._free:
                return
            chunk = codec.decode(payload, Chunk)
            done = max(self._free[name], now + self._latency) + self._duration(
                int(chunk.rollouts.sum())
            )
            self._free[name] = done
            head = {
                "run": chunk.run,
                "incarnation": chunk.incarnation,
                "round": chunk.round,
                "worker": name,
            }
            jobs = chunk.take(np.argsort(chunk.indices).tolist())
            results = Results.carrying(
                self._work.run(self._mu, jobs, self._traces), jobs, 0.0, **head
            )
            self._send(
                done + self._latency,
                Event("result", keys.result(FARM, chunk.run, name), codec.encode(results)),
            )

    def nothing(self, *_: object, **__: object) -> None:
        """Subscriptions, tokens and queries: no other machine asks, or floods."""

    subscribe = watch = token = answer = answer_asked = burden = nothing

    def outlet(self, _: str) -> Silent:
        """A publisher for reports."""
        return Silent()

    def tokens(self, *_: object) -> list[str]:
        """Tokens of other learners."""
        return []


def measure(
    workers: int,
    pairs: int,
    latency: float,
    seconds: float,
    duration: Callable[[int], float],
) -> tuple[float, float]:
    """Duration of a generation, and the learner's processor time in it [s].

    Args:
      workers: how many.
      pairs: of a generation.
      latency: of a message [s].
      seconds: virtual time in which it is measured.
      duration: of a chunk with a number of rollouts [s].
    """
    config = configure("finger-gait", pairs=pairs, generations=10**6)
    network = Network(config, workers, latency, duration)

    @contextmanager
    def listen(*_: object, **__: object) -> Iterator[Network]:
        yield network

    marks: list[tuple[float, float]] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(session, "listen", listen),
        patch.object(time, "monotonic", network.now),
        open_run(
            config, Path(folder) / "run", Placement(fingerprint="c", scheduler=NO_CHECKS)
        ) as run,
        closing(run.learn()) as generations,  # type: ignore[bad-specialization]  # a generator
    ):
        for _ in generations:
            marks.append((network.now(), network.busy))
            if len(marks) > FIRST and marks[-1][0] - marks[FIRST - 1][0] > seconds:
                break
    count = len(marks) - FIRST
    return (marks[-1][0] - marks[FIRST - 1][0]) / count, (
        marks[-1][1] - marks[FIRST - 1][1]
    ) / count


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--workers", default="64,256,1000")
    parser.add_argument("--pair", type=float, default=0.02, help="duration of a pair [s]")
    parser.add_argument("--latency", type=float, default=0.0003, help="of a message [s]")
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        help="duration of each measurement in virtual time [s]",
    )
    arguments = parser.parse_args()
    print(
        "| workers | ms per pair | N | efficiency | learner: us per pair |\n|---|---|---|---|---|"
    )
    for workers in map(int, arguments.workers.split(",")):
        pair = max(arguments.pair, workers / scaling.MOST)
        pairs = max(scaling.PAIRS, scaling.PAIRS * workers // 64)
        halves = partial(operator.mul, pair / 2)
        wall, cpu = measure(workers, pairs, arguments.latency, arguments.seconds, halves)
        efficiency = pairs * pair / workers / wall
        print(
            f"| {workers} | {pair * 1000:g} | {pairs} | {efficiency:.2f} |"
            f" {cpu / pairs * 1e6:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    from running import script

    script(main)
