"""The table of one round: the state of each job, and the jobs that each worker holds.

A job that is not done is in exactly one state: pending, out, full or failed. `Scheduler` decides on
the changes; this module makes them. Times are seconds of the scheduler's clock.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter, defaultdict
from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from learner.pool.admission import host as host_of

_LATE: Final = 7  # a worker that never answers in time is tried once a minute


@dataclass
class WorkerState:
    """The learner's view of a worker, which may be out of date."""

    credits: int
    """Jobs it is willing to hold at once."""
    held: dict[int, float] = field(default_factory=dict[int, float])
    """Time at which each job was sent [s]; done or given-up jobs stay until the worker answers
    them.
    """
    answered: float = -math.inf
    """Time of its last message about its jobs [s]."""
    proven: bool = False
    """Whether the worker has sent a result."""
    asked: bool = False
    """Whether the worker was given jobs of an earlier round."""
    late: int = 0
    """Rounds since the last result at whose end the worker was late, or probes not answered."""
    until: float = -math.inf
    """Time until which the worker's requests do not end its pause [s]."""
    benched: bool = False
    """Whether the worker pauses, as it failed at a job, or was late when a round ended. While there
    are others, it gets no jobs until it sends a message.
    """

    def overdue(self, late: float) -> bool:
        """Whether the worker holds a job sent before `late` [s]."""
        return min(self.held.values(), default=math.inf) <= late

    def bench(self, late: int, now: float) -> None:
        """Give it no jobs for a time that doubles with the number of its late rounds."""
        self.benched, self.late = True, min(late, _LATE)
        self.until = now + 2.0 ** (self.late - 1) - 1.0


class JobTable:
    """Jobs, workers, and the queues the jobs are in."""

    def __init__(self, copies: int) -> None:
        self.copies = copies
        self.given: defaultdict[str, set[int]] = defaultdict(set)
        """Every job of this round sent to a worker, connected or not."""
        self.known: dict[str, WorkerState] = {}
        """Workers that are connected."""
        self.workers: dict[str, WorkerState] = {}
        """Workers that get jobs. New ones join after their first answer."""
        self.asking: dict[str, None] = {}
        """New workers that wait for a probe, in the order in which they asked."""
        self.probes: dict[str, int] = {}
        """Jobs of this round that are probes, by worker."""
        # Workers that are tried once more, at a round's beginning
        self._again: dict[str, None] = {}
        self.begin(0)

    def begin(self, jobs: int, late: float = math.inf, now: float = 0.0) -> None:
        """Forget every job; 0..jobs-1 are pending, and no worker holds anything.

        A worker that is late when a round ends, because it holds a job sent before `late` [s], gets
        no jobs for a while; the pause doubles each time. One that has never answered, while others
        have, must first answer a single probe job. A probe without an answer in the last round is
        repeated once, as its answer may have arrived when that round was over.
        """
        self.size = jobs
        # Jobs that are not done, and the workers expected to answer, in the order of issue.
        self.open: dict[int, list[str]] = {index: [] for index in range(jobs)}
        # Number of errors per job and worker
        self.errors: defaultdict[int, Counter[str]] = defaultdict(Counter)
        self._pending = list(range(jobs))  # a heap; done jobs are removed when they reach the top
        # Job and the time of its change to this state [s]; oldest first, as the clock is monotonic.
        self.out: dict[int, float] = {}  # one more copy is permitted
        self.full: dict[int, float] = {}  # all copies are out
        self.failed: dict[int, float] = {}  # no worker holds it after an error
        proven = self._any_proven()
        for name, worker in self.known.items():
            worker.asked |= bool(self.given.get(name))
            if worker.overdue(late):
                worker.bench(worker.late + 1, now)
                if proven and not worker.proven:
                    del self.workers[name]
            worker.held.clear()
        self.given.clear()
        silent = self.known.keys() - self.workers.keys() - self._again.keys()
        self._again = {name: None for name in self.probes if name in silent}
        self.asking = self._again | self.asking
        self.probes.clear()

    def came(self, worker: str, credits: int) -> WorkerState:
        """The state of a worker; a new one is to be tried, unless no worker has answered yet."""
        if worker not in self.known:
            self.known[worker] = WorkerState(credits)
            if not self._any_proven():
                self.workers[worker] = self.known[worker]
        return self.known[worker]

    def left(self, worker: str) -> None:
        """Forget a worker that holds nothing any more."""
        for table in (self.known, self.workers, self.asking):
            table.pop(worker, None)
        if not self._any_proven():
            self.workers.update(self.known)
            self.asking.clear()

    def prove(self, worker: str) -> None:
        """A worker has answered, so it takes part."""
        self.asking.pop(worker, None)
        if worker in self.known:
            state = self.workers[worker] = self.known[worker]
            state.proven, state.benched, state.late = True, False, 0

    def probe(self, worker: str, now: float) -> int:
        """Give a new worker one job, an open one if there is one; others may take it too, so
        nobody waits for it.

        The last one, or one more before the end for each earlier probe: a device that can do no
        rollout of the mean policy, which is among the last jobs, must not get it every time.
        """
        probes = set(self.probes.values())
        index = next(reversed(self.open), self.size - 1)
        free = (job for job in reversed(self.open) if job not in probes)
        for job in islice(free, self.known[worker].late + 1):
            index = job
        del self.asking[worker]
        if worker not in self._again:
            self.known[worker].bench(self.known[worker].late + 1, now)
        self.probes[worker] = index
        self.given[worker].add(index)
        return index

    def _any_proven(self) -> bool:
        return any(state.proven for state in self.workers.values())

    @property
    def waiting(self) -> int:
        """Pending jobs."""
        return len(self.open) - len(self.out) - len(self.full) - len(self.failed)

    def any_pending(self) -> bool:
        """Say whether there is a job to take."""
        while self._pending and not self._waits(self._pending[0]):
            heapq.heappop(self._pending)
        return bool(self._pending)

    def _waits(self, index: int) -> bool:
        """Whether a job of the heap is to be taken: it is neither done nor held. A job that was
        done as a probe and is opened again is there twice.
        """
        return index in self.open and not self.open[index]

    def take(self, worker: str, count: int, now: float) -> tuple[int, ...]:
        """Give a worker up to `count` pending jobs, lowest index first."""
        indices: list[int] = []
        pending = self._pending
        holdings = self.workers[worker].held
        queue = self.full if self.copies == 1 else self.out
        while pending and len(indices) < count:
            index = heapq.heappop(pending)
            if self._waits(index):
                indices.append(index)
                self.open[index].append(worker)
                holdings[index] = queue[index] = now
        self.given[worker].update(indices)
        return tuple(indices)

    def give(self, index: int, worker: str, now: float) -> None:
        """Give a worker a job that is in no queue, or that other workers hold as well."""
        self._unqueue(index)
        holders = self.open[index]
        if len(holders) >= self.copies:  # drop the oldest holder; its `held` keeps the job
            del holders[0]
        holders.append(worker)
        self.given[worker].add(index)
        self.workers[worker].held[index] = now
        queue = self.full if len(holders) >= self.copies else self.out
        queue[index] = now

    def finish(self, worker: str, indices: Sequence[int]) -> list[bool]:
        """Note results of jobs of this round; return for each whether it was not done before."""
        if indices:
            self.prove(worker)
        holdings: dict[int, float] = {}
        state = self.workers.get(worker)
        if state is not None:
            holdings, state.benched = state.held, False
        done: list[bool] = []
        for index in indices:
            holdings.pop(index, None)
            self._unqueue(index)
            done.append(self.open.pop(index, None) is not None)
        return done

    def fail(self, worker: str, index: int, now: float) -> tuple[bool, bool]:
        """Note an error; return whether it counts, and whether no worker holds the job any more."""
        state = self.workers.get(worker)
        if state is None or index not in self.given[worker]:
            return False, False
        state.benched = True
        holds = state.held.pop(index, None) is not None
        if index not in self.open or (not holds and worker in self.errors[index]):
            return False, False  # done in the meantime, or a duplicate message
        self.errors[index][worker] += 1
        if not self._leave(worker, index, now):
            return True, False
        self.failed[index] = now
        return True, True

    def reopen(self, indices: Sequence[int], host: str) -> None:
        """Make done jobs pending again; later results of that host's workers do not count."""
        for index in indices:
            self.open[index] = []
            heapq.heappush(self._pending, index)
        for name in [name for name in self.given if host_of(name) == host]:
            del self.given[name]

    def release(self, worker: str, now: float) -> int:
        """Take all jobs from a worker that will not answer; return how many are pending again."""
        count = 0
        for index in self.workers[worker].held:
            if index in self.open and self._leave(worker, index, now):
                heapq.heappush(self._pending, index)
                count += 1
        self.workers[worker].held.clear()
        return count

    def free(self, most: int) -> list[tuple[int, str]]:
        """Return a heap of (jobs held, worker) of the workers that may hold one more job."""
        free = [
            (load, name)
            for load, name in self.able()
            if load < min(self.workers[name].credits, most)
        ]
        heapq.heapify(free)
        return free

    def able(self) -> list[tuple[int, str]]:
        """Return (jobs held, worker) of the workers that take jobs at all.

        Benched workers are left out, unless all are benched.
        """
        ready = [(name, state) for name, state in self.workers.items() if not state.benched]
        return [
            (len(state.held), name)
            for name, state in ready or self.workers.items()
            if state.credits
        ]

    def spare(self, most: int, late: float) -> list[tuple[bool, int, str]]:
        """Workers for copies of jobs, as a heap of (has sent no result, jobs held, worker): a copy
        should not wait for a silent worker.

        Workers without a result that hold a job sent before `late` [s] are left out, unless all
        workers are like that: a copy that they hold is missed only after a long time.
        """
        silent = {
            name for name, state in self.workers.items() if not state.proven and state.overdue(late)
        }
        if len(silent) == len(self.workers):
            silent.clear()
        spare = [
            (not self.workers[name].proven, load, name)
            for load, name in self.free(most)
            if name not in silent
        ]
        heapq.heapify(spare)
        return spare

    def pick(
        self, index: int, spare: list[tuple[bool, int, str]], avoided: Container[str], most: int
    ) -> str | None:
        """Take from the heap the first worker that is neither avoided nor holds this job, if
        any.
        """
        passed: list[tuple[bool, int, str]] = []
        picked = None
        while spare and picked is None:
            new, load, name = heapq.heappop(spare)
            if name in avoided or index in self.workers[name].held:
                passed.append((new, load, name))
                continue
            picked = name
            if load + 1 < min(self.workers[name].credits, most):
                passed.append((new, load + 1, name))
        for entry in passed:
            heapq.heappush(spare, entry)
        return picked

    def hopeless(self, index: int, most: int) -> bool:
        """Whether a job has failed on `most` hosts with proven workers, or as often and no worker
        is left to try.
        """
        errors = self.errors[index]
        hosts = {
            host_of(name) for name in errors if name in self.workers and self.workers[name].proven
        }
        none_left = all(name in errors or state.benched for name, state in self.workers.items())
        return len(hosts) >= most or (none_left and errors.total() >= most)

    def _leave(self, worker: str, index: int, now: float) -> bool:
        """Remove a holder of a job; return whether it was the last one, in which case the job is
        in no queue.
        """
        holders = self.open[index]
        if worker not in holders:
            return False
        holders.remove(worker)
        if not holders:
            self._unqueue(index)
        elif self.full.pop(index, None) is not None:
            self.out[index] = now  # one more copy is permitted; the deadline starts anew
        return not holders

    def _unqueue(self, index: int) -> None:
        for queue in (self.out, self.full, self.failed):
            queue.pop(index, None)
