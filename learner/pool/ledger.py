"""The round under way: which job is where, what has come back, and which answers are checked.

Pure.
"""

from collections.abc import Callable, Sequence

import numpy as np

from farm.net.work import Jobs, Results, RoundHeader
from learner.pool.audit import Audit, Source
from learner.pool.round import RoundResults, Shapes
from learner.pool.scheduler import Scheduler, SchedulerConfig, Verdict


class Ledger:
    """One round after another; times are seconds of one monotonic clock."""

    def __init__(
        self,
        config: SchedulerConfig,
        source: Callable[[str], Source | None],
        rng: np.random.Generator,
    ) -> None:
        """Start without a round.

        Args:
          config: how jobs are handed out, and the share that is checked.
          source: of a worker's answers; None if they are not to be checked.
          rng: as in `Audit`.
        """
        self.scheduler = Scheduler(config)
        self.audit = Audit(config.audit, rng)
        self._source = source
        self.round = RoundResults(
            Jobs.exploring(np.empty((0, 0)), (1,), None), "none", Shapes(trace=(0, 0), frame={})
        )
        """The round's jobs and results; before the first round there are none."""

    def begin(self, header: RoundHeader, results: RoundResults) -> None:
        """Start a round with the jobs of these empty results."""
        self.round = results
        self.scheduler.begin(len(results))
        self.audit.begin(header, results)

    @property
    def over(self) -> bool:
        """Whether all jobs of the round are done."""
        return self.scheduler.complete

    def due(self, now: float) -> Sequence[tuple[str, Sequence[int]]]:
        """The jobs to send now, by worker."""
        return [] if self.over else self.scheduler.assign(now)

    def put(self, message: Results, now: float) -> list[Verdict]:
        """Store what is new in a message; the verdict on each of its jobs, none if the results do
        not fit their jobs.
        """
        place = self.round.place(message)
        if place is None:
            return []
        over = self.over
        verdicts = self.scheduler.results(
            message.worker, message.jobs.tolist(), now, message.seconds
        )
        new = np.array([verdict == "new" for verdict in verdicts])
        self.round.put(message, place, new)
        source = self._source(message.worker)
        if source and new.any():
            self.audit.counted(source, message.jobs[new])
        for job, verdict in zip(message.jobs.tolist(), verdicts, strict=True):
            # A copy, or a new worker's probe job
            if verdict in ("doubled", "tried"):
                answer = self.round.given(message, job)
                if answer != self.round.answer(job):
                    self.audit.differed(source, job, answer)
        if self.over and not over:
            self.audit.ended()
        return verdicts

    def lost(self, worker: str) -> int:
        """A worker has left the run; return how many of its jobs are sent again."""
        return self.scheduler.lost(worker)

    def expel(self, host: str) -> int:
        """Discard a host's results of this round; return how many of its jobs are repeated."""
        jobs = self.audit.expel(host)
        self.scheduler.reopen(jobs, host)
        self.round.forget(jobs)
        return len(jobs)
