"""What a chunk costs, by the last answers, and the chunk sizes and deadlines that follow from
it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from farm.settings import Settings, setting

_SAMPLES = 64
_APART = 1.5  # ratio of chunk sizes from which the overhead can be told
# The line is believed up to so many times the largest chunk whose time is known; then the median
# counts
_FURTHER = 2
# Chunks that a learner sends and receives per second: this takes a third of a core
_MESSAGES = 300.0


@dataclass(frozen=True, kw_only=True)
class SchedulerConfig(Settings):
    """Settings of how jobs are handed out, when a job also goes to a second worker, and when it
    fails for good.
    """

    chunk_seconds: float = setting(0.2, above=0.0)
    """Work sent to a worker in one message [s], by the running median; more if there are more
    than 60 workers.
    """
    least_seconds: float = setting(0.015, above=0.0)
    """Towards the end of a round chunks shrink down to this [s], or to `least_overheads`."""
    least_overheads: float = setting(3.0, least=0.0)
    """Chunks do not shrink below this many times the part of their time that does not depend on
    their size.
    """
    short_seconds: float = setting(0.1, least=0.0)
    """If a worker's whole share of a round takes at most this [s], it is sent in one message."""
    short_overheads: float = setting(10.0, least=0.0)
    """If a worker's whole share of a round takes at most this many times the part of a chunk's time
    that does not depend on its size, it is sent in one message.
    """
    straggler_factor: float = setting(4.0, least=1.0)
    """A job unanswered for this many times the running median also goes to another worker."""
    straggler_seconds: float = setting(1.0, above=0.0)
    """Least time before a job also goes to another worker [s]."""
    copies: int = setting(3, least=1)
    """Largest number of workers that hold the same job; 1 means no copies."""
    max_errors: int = setting(3, least=1)
    """Number of hosts on which one job must fail before the run stops."""
    instances: int = setting(500, least=1, most=10_000)
    """Largest number of workers of one name, that is of one certificate."""
    audit: float = setting(0.02, least=0.0, most=1.0)
    """Share of the answers of other machines that the checker repeats; 0: no checks."""


class Chunking:
    """The time of a chunk, and the running median of seconds until an answer, over the last answers
    of all workers.

    A chunk of n jobs takes about overhead + n x slope: each control step of a batch has a part that
    does not grow with the batch, and in small models it is most of the time. Seconds are the
    workers' own, because a worker that other learners use too works on their chunks between two of
    this one's.
    """

    def __init__(self, config: SchedulerConfig) -> None:
        self._config = config
        self._samples: deque[tuple[int, float]] = deque(maxlen=_SAMPLES)
        self._waits: deque[float] = deque(maxlen=_SAMPLES)
        self._median: float | None = None  # computed when it is needed, as is the next one
        self._wait: float | None = 0.0
        self._overhead, self._slope, self._known = 0.0, 0.0, 0
        self._seconds = 0.0  # duration of the round's longest chunk

    def learn(self, jobs: int, wait: float, seconds: float = 0.0) -> None:
        """Take in one answer.

        Args:
          jobs: number of its jobs.
          wait: time since the worker could begin with them [s].
          seconds: how long it worked on them, by its own account [s]; 0: not measured.
        """
        self._waits.append(max(wait, 0.0))
        self._samples.append((jobs, min(seconds, self._waits[-1]) or self._waits[-1]))
        self._median = self._wait = None

    @property
    def median(self) -> float | None:
        """Running median of the time per job [s], None before the first answer."""
        if self._median is None and self._samples:
            self._median = median(seconds / jobs for jobs, seconds in self._samples)
            self._fit(self._median)
        return self._median

    def _fit(self, each: float) -> None:
        """Fit overhead and slope: a line through the medians of the smaller and the larger third of
        the answers.

        (Tukey's resistant line, so that single late answers do not count.) If their sizes hardly
        differ, the overhead is as before.
        """
        ordered = sorted(self._samples)
        self._known = _FURTHER * ordered[-1][0]
        third = len(ordered) // 3
        small, large = (
            [median(values) for values in zip(*part, strict=True)]
            for part in (ordered[: third or 1], ordered[-third or -1 :])
        )
        if third and large[0] >= _APART * small[0]:
            self._slope = max(0.0, (large[1] - small[1]) / (large[0] - small[0]))
            self._overhead = max(0.0, small[1] - self._slope * small[0])
        else:
            jobs = median(jobs for jobs, _ in self._samples)
            self._overhead = min(self._overhead, each * jobs)
            self._slope = each - self._overhead / jobs

    @property
    def patience(self) -> float:
        """Time after which an unanswered job is overdue [s]; allows for a wait behind another
        chunk.
        """
        if self._wait is None:
            self._wait = median(self._waits)
        return max(
            self._config.straggler_seconds,
            self._config.straggler_factor * max(self._wait, self._seconds),
        )

    def chunk(self, jobs: int, waiting: int, workers: int) -> int:
        """Return the number of jobs to send at once.

        About `chunk_seconds` of work, or more if there are so many workers that the learner could
        not serve them in that time. At most half a worker's share of the pending jobs, so that
        chunks shrink towards the end and all workers finish together. At least `least_seconds` and
        `least_overheads`, unless a worker's share is less. In a short round each worker gets its
        whole share at once, because splitting it would cost more time than uneven finishing. One
        job until the first duration is known.

        Args:
            jobs: number of jobs in the round.
            waiting: number of these that are pending.
            workers: number of workers.
        """
        if self.median is None:
            return 1
        share, half = (-(-waiting // (parts * max(workers, 1))) for parts in (1, 2))
        whole = self._duration(-(-jobs // max(workers, 1)))
        if whole <= max(self._config.short_seconds, self._config.short_overheads * self._overhead):
            return max(1, share)
        least = max(self._config.least_seconds, self._config.least_overheads * self._overhead)
        most = max(self._config.chunk_seconds, workers / _MESSAGES)
        self._seconds = min(most, 0.5 * whole)
        return max(
            1,
            min(share, math.floor(self._jobs(least))),
            min(half, math.floor(self._jobs(most) + 0.5)),
        )

    def _duration(self, jobs: int) -> float:
        """Duration of a chunk of some jobs [s]."""
        # With a median of 0 (a coarse clock) the share decides
        each = max(self.median or 0.0, 1e-9)
        return self._overhead + jobs * self._slope if jobs <= self._known else jobs * each

    def _jobs(self, seconds: float) -> float:
        """The number of jobs that take so long in one chunk."""
        line = (seconds - self._overhead) / max(self._slope, 1e-9)
        return max(seconds / max(self.median or 0.0, 1e-9), min(line, self._known))
