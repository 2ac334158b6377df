"""A runner of several processes of this machine, for what the learner simulates itself: a pilot
before its run has workers, and the baselines that its result is compared with.
"""

import math
import queue
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from farm.arrays import AnyArray, FloatArray
from farm.errors import FarmError, Interrupted
from farm.net.work import NOT_NORMALISED, Jobs, Simulated
from farm.runner_process import Begin
from farm.subprocess_runner import RunnerProcess, SubprocessRunner
from learner.run.setup import Problem

_TIMED: Final = 8  # jobs that this process runs first, and times
BEGINNING: Final = 4.0
"""Time in which processes import a robot's packages and build its model [s]."""

TURN: Final = 2.0
"""Time of jobs in this process between two looks whether to stop [s]."""

_PARTS: Final = 4  # of each process's jobs, as some take longer than others
_LONGEST: Final = 30.0  # [s] of a part

A = TypeVar("A")
B = TypeVar("B")


class ParallelRunner:
    """Runs a problem's jobs as `farm.runner.Runner.run` does, with the same numbers: in this
    process, or by several if that would take seconds.
    """

    def __init__(
        self, problem: Problem, processes: int, stopped: Callable[[], bool] = lambda: False
    ) -> None:
        """Prepare the simulation in this process.

        Args:
          problem: what is simulated.
          processes: at most so many are started.
          stopped: whether the user has asked to stop; called between jobs.

        Raises:
          ConfigError: the task cannot start.
        """
        self.spec = problem.spec
        self._problem = problem
        self._processes = processes
        self._stopped = stopped
        self._here = problem.runner()
        self._each: float | None = None  # [s] of a rollout in this process
        self._others: list[SubprocessRunner] | None = None
        self._open = ExitStack()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that were started."""
        return [each.pid for each in self._others or ()]

    def run(self, mu: FloatArray, jobs: Jobs, normaliser: FloatArray = NOT_NORMALISED) -> Simulated:
        """Run jobs around a mean (P,), without traces.

        Raises:
          Interrupted: the user asked to stop.
        """
        results: list[Simulated] = []
        at = 0
        while at < len(jobs):
            left = jobs.take(range(at, len(jobs)))
            if self._pays(left):
                results += self._together(mu, self._parts(left), normaliser)
                break
            count = self._soon(left)
            results.append(self._alone(mu, left.take(range(count)), normaliser))
            at += count
        return joined(results)

    def close(self) -> None:
        """End the processes."""
        self._open.close()
        self._here.close()

    def _pays(self, jobs: Jobs) -> bool:
        """Whether several processes do these jobs sooner than this one."""
        if self._processes < 2 or self._each is None:
            return False
        gain = self._seconds(jobs) * (1.0 - 1.0 / self._processes)
        return self._others is not None or gain > BEGINNING

    def _seconds(self, jobs: Jobs) -> float:
        """Time that jobs would take in this process [s]."""
        return (self._each or 0.0) * int(jobs.rollouts.sum())

    def _soon(self, jobs: Jobs) -> int:
        """How many of these jobs this process does before it looks whether to stop."""
        if self._each is None:
            return min(_TIMED, len(jobs))
        return max(1, min(len(jobs), int(len(jobs) * TURN / max(self._seconds(jobs), 1e-9))))

    def _parts(self, jobs: Jobs) -> list[Jobs]:
        """The jobs, cut for the processes."""
        least = math.ceil(self._seconds(jobs) / _LONGEST)
        size = math.ceil(len(jobs) / max(_PARTS * self._processes, least))
        order = range(len(jobs))
        return [jobs.take(order[at : at + size]) for at in range(0, len(jobs), size)]

    def _alone(self, mu: FloatArray, jobs: Jobs, normaliser: FloatArray) -> Simulated:
        if self._stopped():
            raise Interrupted("the simulation was stopped")
        begun = time.perf_counter()
        results = self._here.run(mu, jobs, "none", normaliser)
        self._each = (time.perf_counter() - begun) / len(results.returns)
        return results

    def _together(
        self, mu: FloatArray, parts: Sequence[Jobs], normaliser: FloatArray
    ) -> Iterator[Simulated]:
        """Results of each part, in order; this process repeats what another one cannot do."""
        if self._others is None:
            self._others = []
            with suppress(OSError, RuntimeError):  # no room for more files, processes or threads
                self._others = self._started()
        results: list[Simulated | None] = [None] * len(parts)
        if self._others:
            idle: queue.SimpleQueue[SubprocessRunner] = queue.SimpleQueue()
            for runner in self._others:
                idle.put(runner)

            def simulated(part: Jobs) -> Simulated | None:
                runner = idle.get()
                try:
                    return None if self._stopped() else runner.run(mu, part, "none", normaliser)
                except (FarmError, OSError):
                    return None
                finally:
                    idle.put(runner)

            with suppress(RuntimeError):
                results = _threaded(simulated, parts, len(self._others))
        for part, result in zip(parts, results, strict=True):
            yield self._alone(mu, part, normaliser) if result is None else result

    def _started(self) -> list[SubprocessRunner]:
        """Processes that have built the task; fewer if some cannot."""
        folder = Path(self._open.enter_context(tempfile.TemporaryDirectory()))
        for digest, content in self._problem.assets.items():
            (folder / digest).write_bytes(content)
        begin = Begin(
            spec=self._problem.specification("here"),
            files=tuple(str(path.absolute()) for path in self._problem.files),
            assets=str(folder),
            backend="cpu",
        )
        here, python = Path.cwd(), [sys.executable]

        def built(process: RunnerProcess) -> SubprocessRunner | None:
            try:
                return SubprocessRunner(begin, here, process, python)
            except (FarmError, OSError):
                return None

        processes = []
        for _ in range(self._processes):
            processes.append(RunnerProcess(here, python))
            self._open.callback(processes[-1].close)
        runners = [each for each in _threaded(built, processes, len(processes)) if each is not None]
        for runner in runners:
            self._open.callback(runner.close)
        return runners


def _threaded(call: Callable[[A], B], values: Sequence[A], threads: int) -> list[B]:
    """Results of calls on so many threads, in order; Ctrl-C begins no further one."""
    executor = ThreadPoolExecutor(threads)
    try:
        return list(executor.map(call, values))
    finally:
        executor.shutdown(cancel_futures=True)


def joined(parts: Sequence[Simulated]) -> Simulated:
    """Results of jobs one after another, as of one call; without traces."""

    def rows(of: Callable[[Simulated], AnyArray]) -> AnyArray:
        return np.concatenate([of(part) for part in parts])

    warned: Counter[str] = Counter()
    for part in parts:
        warned.update(part.warned)
    failing = next((part for part in parts if part.error), parts[0])
    return Simulated(
        trajectories=tuple(each for part in parts for each in part.trajectories),
        returns=rows(lambda part: part.returns),
        flags=rows(lambda part: part.flags),
        steps=rows(lambda part: part.steps),
        traces=parts[0].traces[:0],
        moments=rows(lambda part: part.moments),
        measures=rows(lambda part: part.measures),
        terms=rows(lambda part: part.terms),
        error=failing.error,
        traceback=failing.traceback,
        warned=dict(warned),
    )
