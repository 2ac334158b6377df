"""The round under way: which job is where, which are checked by a second host, and what has come
back.

Pure.
"""

from collections.abc import Callable, Sequence

import numpy as np

from farm.net.work import Jobs, Results
from learner.scheduler.audit import Audit
from learner.scheduler.round import RoundResults, Shapes
from learner.scheduler.scheduler import Scheduler, SchedulerConfig, Verdict


class Ledger:
    """One round after another; times are seconds of one monotonic clock."""

    def __init__(
        self, config: SchedulerConfig, canary: Callable[[str], str] | None, rng: np.random.Generator
    ) -> None:
        """Start without a round; `canary` and `rng` are as in `Audit`."""
        self.scheduler = Scheduler(config)
        self.audit = Audit(config.audit, rng, canary)
        self.round = RoundResults(
            Jobs.exploring(np.empty((0, 0)), (1,), None), "none", Shapes(trace=(0, 0), frame={})
        )
        """The round's jobs and results; before the first round there are none."""

    def begin(self, results: RoundResults) -> None:
        """Start a round with the jobs of these empty results."""
        self.round = results
        self.scheduler.begin(len(results))
        self.audit.begin(len(results))

    @property
    def over(self) -> bool:
        """Whether all jobs are done and checked."""
        return self.scheduler.complete and self.audit.passed(self.round, self.scheduler.willing)

    def due(self, now: float) -> list[tuple[str, Sequence[int]]]:
        """The jobs to send now, by worker: spot checks, then those that are not done."""
        if self.over:
            return []
        complete, patience = self.scheduler.complete, self.scheduler.patience
        if not complete and self.audit.early and self.scheduler.half_done:
            self.audit.choose(self.round, self.scheduler.willing, end=False)
        checks: dict[str, list[int]] = {}
        if self.audit.due(now, patience):
            checks = self.audit.assign(self.scheduler.willing, now, patience)
        for worker, indices in checks.items():
            self.scheduler.lend(worker, indices)
        return [*checks.items(), *self.scheduler.assign(now)]

    def put(
        self, message: Results, now: float, judge: Callable[[int, str], bytes | None] | None = None
    ) -> tuple[list[Verdict], dict[str, int]]:
        """Store what is new in a message; `judge` is as in `Audit.settle`.

        Returns:
          The verdict on each of its jobs, none if the results do not fit their jobs; and hosts
          whose numbers are wrong, each with such a job.
        """
        place = self.round.place(message)
        if place is None:
            return [], {}
        verdicts = self.scheduler.results(
            message.worker, message.jobs.tolist(), now, message.seconds
        )
        new = np.array([verdict == "new" for verdict in verdicts])
        self.round.put(message, place, new)
        if new.any():
            self.audit.counted(message.worker, message.jobs[new])
        if not {"doubled", "tried"}.intersection(verdicts):
            return verdicts, {}
        for at, (job, verdict) in enumerate(zip(message.jobs.tolist(), verdicts, strict=True)):
            # For a check, after a copy, a trial: two hosts must agree to the bit
            if verdict in ("doubled", "tried"):
                stored, answer = self.round.answer(job), self.round.given(message, job)
                verdicts[at] = (
                    "new" if self.audit.answered(message.worker, job, stored, answer) else verdict
                )
        return verdicts, self.audit.settle(judge)

    def lost(self, worker: str) -> int:
        """A worker has left the run; return how many of its jobs are sent again."""
        self.audit.lost(worker)
        return self.scheduler.lost(worker)

    def expel(self, host: str) -> int:
        """Discard a host's results of this round; return how many of its jobs are repeated."""
        jobs = self.audit.expel(host)
        self.scheduler.reopen(jobs, host)
        self.round.forget(jobs)
        return len(jobs)
