"""How fast jobs go: the running median, and the chunk sizes and deadlines that follow from it."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from farm.settings import Settings, setting

_SAMPLES = 64
_MESSAGES = 300.0  # chunks that a learner sends, and reads the results of, per second: a third of a core


@dataclass(frozen=True, kw_only=True)
class SchedulerConfig(Settings):
    """How jobs are handed out, and when one is given to a second worker or given up."""

    chunk_seconds: float = setting(0.2, above=0.0)
    """Work sent to a worker in one message [s], by the running median; more where there are more than 60 workers."""
    least_seconds: float = setting(0.015, above=0.0)
    """Towards the end of a round chunks shrink down to this [s]: rollouts in small batches are slower."""
    short_seconds: float = setting(0.06, least=0.0)
    """A round is short where a worker's share takes no longer; it goes out in one message [s]."""
    straggler_factor: float = setting(4.0, least=1.0)
    """A job out longer than this many running medians is copied to another worker."""
    straggler_seconds: float = setting(1.0, above=0.0)
    """A job is never copied sooner than this [s]."""
    copies: int = setting(3, least=1)
    """Workers that may hold one job at once; 1 means no copies."""
    max_errors: int = setting(3, least=1)
    """Different workers that answer an error for one job before the run stops."""
    audit: float = setting(0.02, least=0.0, most=1.0)
    """Part of the jobs that a second host does as well, where there is one; 0: no spot checks."""


class Chunking:
    """The running median of seconds per job, over the last answers of all workers."""

    def __init__(self, config: SchedulerConfig) -> None:
        self._config = config
        self._samples: deque[float] = deque(maxlen=_SAMPLES)
        self._median: float | None = None  # until it is asked for
        self._seconds = 0.0  # what the longest chunk of the round takes

    def learn(self, seconds: float) -> None:
        """Take in one answer's time per job [s]."""
        self._samples.append(max(seconds, 0.0))
        self._median = None

    @property
    def median(self) -> float | None:
        """Running median [s], None before the first answer."""
        if self._median is None and self._samples:
            self._median = median(self._samples)
        return self._median

    @property
    def patience(self) -> float:
        """Time after which a job that is out counts as a straggler [s]; it may have waited behind a chunk."""
        factor = self._config.straggler_factor
        return max(self._config.straggler_seconds, factor * max(self.median or 0.0, self._seconds))

    def chunk(self, jobs: int, waiting: int, workers: int) -> int:
        """Return the number of jobs to send at once.

        Some `chunk_seconds` of work, or more where the learner could not answer so many workers in that time, but at
        most half a worker's share of what waits, so that chunks shrink towards the end and all workers end together;
        never below `least_seconds`,
        unless a worker's whole share is less. In a short round each worker has its whole share at once: the time lost
        when one ends later is less than what a batch in two parts takes longer. One job as long as nothing is known
        about its duration.

        Args:
            jobs: of the round.
            waiting: of these, not given out yet.
            workers: that take part.
        """
        if self.median is None:
            return 1
        seconds = max(self.median, 1e-9)  # a median of 0 (a coarse clock) only says that the share decides
        share, half = (-(-waiting // (parts * max(workers, 1))) for parts in (1, 2))
        whole = -(-jobs // max(workers, 1)) * seconds
        if whole <= self._config.short_seconds:
            return max(1, share)
        least = min(share, math.floor(self._config.least_seconds / seconds))
        most = max(self._config.chunk_seconds, workers / _MESSAGES)
        self._seconds = min(most, 0.5 * whole)
        return max(1, least, min(half, math.floor(most / seconds + 0.5)))
