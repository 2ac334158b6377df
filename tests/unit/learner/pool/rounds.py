"""A scheduler in a round, and what it has given out."""

from learner.pool.scheduler import Scheduler, SchedulerConfig


def started(jobs, workers=(), *, credits=4, seconds=None, **config):
    """Return a scheduler in a round of `jobs`; `seconds` per job are known from an earlier
    round.
    """
    scheduler = Scheduler(
        SchedulerConfig(**{"chunk_seconds": 0.08, "short_seconds": 0.0, **config})
    )
    if seconds is not None:
        scheduler.begin(1)
        scheduler.want("teacher", 1, now=-seconds)
        scheduler.assign(now=-seconds)
        assert scheduler.results("teacher", [0], now=0.0) == ["new"]
        scheduler.lost("teacher")
    scheduler.begin(jobs)
    for worker in workers:
        scheduler.want(worker, credits, now=0.0)
    return scheduler


def by_worker(chunks):
    """Return the jobs by worker."""
    jobs = {}
    for worker, indices in chunks:
        jobs.setdefault(worker, []).extend(indices)
    return jobs
