"""The scheduler: decides which worker gets which job of a round, and when again. No I/O, no clock.

A round is a generation's jobs 0..n-1. Messages may be lost, duplicated or late, and workers may
join and leave. Each job is counted once, by its first result, even if that comes from a worker that
was no longer expected to send it.

    pending --assign--> out --result--> done
       ^                 | lost, idle, error: no worker holds it any more
       +-----------------+ overdue: a copy goes to another worker

Times are seconds of one monotonic clock, passed in as `now`.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Container, Sequence, Set
from typing import Literal, NamedTuple, TypeAlias

from learner.pool.chunking import Chunking, SchedulerConfig
from learner.pool.job_table import JobTable

__all__ = ["Assignment", "Scheduler", "SchedulerConfig", "Verdict"]

Verdict: TypeAlias = Literal["new", "doubled", "tried", "stale", "unasked"]

# If all copies of a job are out, the one of the oldest holder is replaced after this many times the
# patience: workers that hang but stay connected must not block a round forever.
_GIVE_UP = 10.0


class Assignment(NamedTuple):
    """Jobs to send to a worker in one message."""

    worker: str
    indices: tuple[int, ...]


class Scheduler:
    """Assigns the jobs of one round after another to workers."""

    def __init__(self, config: SchedulerConfig) -> None:
        self._config = config
        self._chunking = Chunking(config)
        self._table = JobTable(config.copies)
        self._begun = False
        self._reissued = 0
        self._now = -math.inf
        self._seen = -math.inf  # `assign` has handled the deadlines up to this time [s]

    @property
    def complete(self) -> bool:
        """Whether a round has started and all its jobs are done."""
        return self._begun and not self._table.open

    @property
    def remaining(self) -> int:
        """Jobs of this round that are not done."""
        return len(self._table.open)

    @property
    def workers(self) -> Set[str]:
        """Names of the known workers."""
        return self._table.known.keys()

    @property
    def reissued(self) -> int:
        """Number of jobs issued again, over all rounds: after a loss, an error, or as a copy."""
        return self._reissued

    def begin(self, jobs: int) -> None:
        """Start a round of `jobs` jobs; the old round is dropped, workers and credits are kept."""
        if jobs < 0:
            raise ValueError(f"jobs is {jobs}, expected 0 or more")
        self._begun = True
        self._table.begin(jobs, self._now - self._chunking.patience, self._now)
        self._seen = -math.inf

    def want(self, worker: str, credits: int, now: float, *, idle: bool = False) -> None:
        """Note that a worker is connected, and how many jobs it is willing to hold at once.

        Args:
            worker: its name; an unknown worker joins.
            credits: largest number of jobs that it may hold, a new chunk included.
            now: time [s].
            idle: it has nothing to do: jobs sent to it, or their results, were lost on the way, so
                they are pending again.
        """
        if credits < 0:
            raise ValueError(f"credits of {worker} is {credits}, expected 0 or more")
        self._tick(now)
        state = self._table.came(worker, credits)
        state.credits, state.benched = credits, state.benched and self._now < state.until
        if worker not in self._table.workers:
            if credits and not state.benched and (idle or not state.late):
                self._table.asking[worker] = None
        elif idle:
            state.answered = self._now
            self._reissued += self._table.release(worker, self._now)

    def lost(self, worker: str) -> int:
        """Forget a worker; return how many of its jobs are pending again."""
        self._seen = -math.inf
        count = self._table.release(worker, self._now) if worker in self._table.workers else 0
        self._reissued += count
        self._table.left(worker)
        return count

    def declined(self, worker: str) -> int:
        """Forget a worker that cannot build the task, and its errors, which say nothing about the
        jobs; as `lost`.
        """
        for errors in self._table.errors.values():
            errors.pop(worker, None)
        return self.lost(worker)

    def unread(self, worker: str) -> Verdict | None:
        """The verdict on results of a worker that was given no job of this round, unread; None if
        it was given some.

        "stale": it is connected and was given jobs of an earlier round. So it has answered, and
        takes part.
        """
        if self._table.given.get(worker):
            return None
        state = self._table.known.get(worker)
        if state is None or not state.asked:
            return "unasked"
        self._table.prove(worker)
        return "stale"

    def results(
        self, worker: str, indices: Sequence[int], now: float, seconds: float = 0.0
    ) -> list[Verdict]:
        """Note the results in a message, simulated in some seconds (0: not measured); return a
        verdict for each.

        Only "new" counts. "doubled": the job was done before; "tried": a new worker's probe, a
        job that others have done already; "stale": not a job of this round; "unasked": this
        worker was never given it in this round. Results of a worker that has left count. The
        caller must drop messages of other rounds.
        """
        self._tick(now)
        self._learn(worker, indices, seconds)
        issued = self._table.given.get(worker, ())
        new = iter(self._table.finish(worker, [index for index in indices if index in issued]))
        return [
            (
                "stale"
                if not 0 <= index < self._table.size
                else (
                    "unasked"
                    if index not in issued
                    else (
                        "new"
                        if next(new)
                        else "tried"
                        if self._table.probes.get(worker) == index
                        else "doubled"
                    )
                )
            )
            for index in indices
        ]

    def reopen(self, indices: Sequence[int], host: str) -> None:
        """Make a host's done jobs pending again; later results of its workers in this round do
        not count.
        """
        self._seen = -math.inf
        self._reissued += len(indices)
        self._table.reopen(indices, host)

    def holds(self, worker: str) -> bool:
        """Whether a worker has jobs of this round that it has not answered."""
        state = self._table.workers.get(worker)
        return state is not None and bool(state.held)

    @property
    def patience(self) -> float:
        """Time after which an unanswered job is overdue [s]."""
        return self._chunking.patience

    def error(self, worker: str, index: int, now: float) -> bool:
        """Note that a job failed on a worker; return whether the run must stop.

        It must if the job failed on `max_errors` hosts that have sent results before, or failed as
        often and no worker is left to try: a defect of some machines must not stop a run that
        others can serve. Until then the job is issued again, to a different worker if possible.
        Errors of unknown workers are ignored. A worker that cannot build the task has tried no job:
        for that see `refused`.
        """
        self._tick(now)
        counts, again = self._table.fail(worker, index, self._now)
        self._reissued += again
        if worker in self._table.workers:
            self._table.workers[worker].answered = self._now
        return counts and self._table.hopeless(index, self._config.max_errors)

    def failed_at(self, index: int) -> list[str]:
        """The workers that have failed at a job."""
        return list(self._table.errors[index])

    def assign(self, now: float) -> list[Assignment]:
        """Return the chunks to send now, within the credits, and count them as sent.

        Workers with the fewest jobs come first, then by name. Each holds about two chunks, the one
        it works on and the next one; the other jobs stay pending here, so that all workers finish
        together.
        """
        self._tick(now)
        chunks = self._again(self._table.failed)
        chunks += self._first_time()
        if not self._table.any_pending():
            chunks += self._again(self._table.out)
            chunks += self._again(self._table.full)
        chunks += self._probes()
        self._seen = self._now
        return chunks

    def next_deadline(self, now: float) -> float | None:
        """Return the seconds until `assign` must be called again even if no message arrives, or
        None.

        Overdue jobs that the last `assign` could not place wait for a message: a result or a new
        worker.
        """
        dues: list[float] = []
        for queue in (self._table.out, self._table.full, self._table.failed):
            wait = self._wait(queue)
            ahead = (since + wait for since in queue.values() if since + wait > self._seen)
            dues.extend(due for due in (next(ahead, None),) if due is not None)
        return max(0.0, min(dues) - now) if dues else None

    def _tick(self, now: float) -> None:
        self._now = max(self._now, now)
        self._seen = -math.inf

    def _learn(self, worker: str, indices: Sequence[int], seconds: float) -> None:
        """Learn the time of the jobs: from when the worker could start."""
        state = self._table.workers.get(worker)
        if state is None:
            return
        times = [state.held[index] for index in set(indices) if index in state.held]
        if times:
            self._chunking.learn(len(times), self._now - max(state.answered, min(times)), seconds)
            state.answered = self._now

    def _size(self) -> int:
        """Jobs of a chunk."""
        return self._chunking.chunk(self._table.size, self._table.waiting, len(self._table.able()))

    def _first_time(self) -> list[Assignment]:
        """Hand out pending jobs in chunks, lowest index first; evenly if there are not two
        chunks for each worker.
        """
        if not self._table.any_pending():
            return []
        size = self._size()
        free = self._table.free(2 * size)
        total = sum(load for load, _ in free)
        chunks: list[Assignment] = []
        while free and self._table.any_pending():
            load, name = heapq.heappop(free)
            # Two chunks fit into the credits, so that one travels while the other is computed.
            credits = self._table.workers[name].credits
            chunk = min(size, (credits + 1) // 2)
            if load > chunk:
                total -= load
                continue
            # Until all hold the same number
            even = -(-(self._table.waiting + total) // (len(free) + 1)) - load
            indices = self._table.take(name, min(chunk, even, credits - load), self._now)
            chunks.append(Assignment(name, indices))
            total -= load
            load += len(indices)
            if load < credits and load <= chunk:
                heapq.heappush(free, (load, name))
                total += load
        return chunks

    def _probes(self) -> list[Assignment]:
        """One job for each new worker that asks."""
        if not self._table.size:
            return []
        return [
            Assignment(name, (self._table.probe(name, self._now),))
            for name in list(self._table.asking)
        ]

    def _again(self, queue: dict[int, float]) -> list[Assignment]:
        """Issue failed or overdue jobs to workers that have room and do not hold them."""
        due = self._due(queue)
        if not due:
            return []
        size = self._size()
        spare = self._table.spare(2 * size, self._now - self._chunking.patience)
        chunks: dict[str, list[int]] = {}
        for index in due:
            if not spare:
                break
            name = self._table.pick(index, spare, self._avoided(index), 2 * size)
            if name is not None:
                self._reissued += queue is not self._table.failed  # failed jobs were counted before
                self._table.give(index, name, self._now)
                chunks.setdefault(name, []).append(index)
        return [Assignment(name, tuple(indices)) for name, indices in chunks.items()]

    def _wait(self, queue: dict[int, float]) -> float:
        return self._chunking.patience * (_GIVE_UP if queue is self._table.full else 1.0)

    def _due(self, queue: dict[int, float]) -> list[int]:
        """Return the jobs to issue again: overdue ones, oldest first, and every failed one."""
        if queue is self._table.failed:
            return list(queue)
        wait = self._wait(queue)
        due: list[int] = []
        for index, since in queue.items():
            if since + wait > self._now:
                break
            due.append(index)
        return due

    def _avoided(self, index: int) -> Container[str]:
        """Return the workers that failed at a job, while a different worker may still take it in
        time.
        """
        failed = self._table.errors[index]
        since = self._table.failed.get(index, -math.inf)
        if since + self._wait(self._table.failed) <= self._now:
            return ()
        return failed if any(name not in failed for name in self._table.workers) else ()
