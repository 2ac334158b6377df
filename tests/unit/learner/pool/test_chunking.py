"""What a chunk costs, and how small chunks may become."""

import pytest

from learner.pool.chunking import Chunking, SchedulerConfig


def learnt(times, **config):
    """After answers (jobs, seconds)."""
    chunking = Chunking(SchedulerConfig(short_seconds=0.0, **config))
    for jobs, seconds in times:
        chunking.learn(jobs, seconds)
    return chunking


def test_the_time_per_job_is_the_median_over_answers():
    assert learnt([]).median is None
    assert learnt([(1, 0.01), (2, 0.08), (10, 0.2)]).median == pytest.approx(0.02)
    assert learnt([]).chunk(40, 40, 2) == 1


def test_chunks_do_not_shrink_into_the_overhead():
    """A chunk of n jobs takes 30 ms + 3 ms n, here and there 1 s more: it has at least 90 ms of
    work.
    """
    times = [
        (n, 0.03 + 0.003 * n + (1.0 if i % 9 == 0 else 0.0))
        for i, n in enumerate([1, 2, 3, 5, 8, 12, 20] * 6, 1)
    ]
    chunking = learnt(times)
    assert chunking.chunk(40, 4, 2) == 2, "a worker's share"
    assert chunking.chunk(400, 40, 2) == pytest.approx(20, rel=0.4), (
        "30 + 3 x 20 ms, more than half a share"
    )
    free = learnt(times, least_overheads=0.0, least_seconds=1e-6)
    assert free.chunk(400, 4, 2) == 1, "down to half a share"


def test_the_overhead_is_kept_while_all_chunks_are_alike():
    chunking = learnt([(n, 0.03 + 0.003 * n) for n in [1, 20] * 32])
    assert chunking.chunk(400, 60, 2) == 20
    for _ in range(64):
        chunking.learn(20, 0.09)
    assert chunking.chunk(400, 60, 2) == 20, "not half a share, which is 15"


def test_a_task_that_is_mostly_overhead_is_not_cut_in_its_second_round():
    """A two-link arm: 60 ms for one job, 62 ms for two, 88 ms for a worker's share of 15."""
    chunking = learnt([(n, 0.058 + 0.002 * n) for n in [1, 1, 1, 2, 2, 2]])
    assert chunking.chunk(30, 30, 2) == 4, "twice what is known"
    chunking.learn(4, 0.066)
    chunking.learn(4, 0.066)
    assert chunking.chunk(30, 30, 2) == 15


def test_a_line_through_small_chunks_is_not_believed_far_beyond_them():
    chunking = learnt([(n, 0.003) for n in [1, 2] * 8])
    assert chunking.chunk(10_000, 10_000, 2) == 89, (
        "0.2 s by the median, 2.25 ms; by the line any number of jobs"
    )


def test_work_without_overhead_is_split_as_before():
    chunking = learnt([(n, 0.004 * n) for n in [1, 2, 5, 10] * 8])
    assert chunking.chunk(400, 10, 2) == 3, "15 ms are three jobs, half a share as well"
    assert chunking.chunk(400, 400, 2) == 50, "0.2 s"


def test_a_worker_that_others_use_too_gets_no_smaller_chunks() -> None:
    alone, shared = (Chunking(SchedulerConfig()) for _ in range(2))
    for jobs in [1] * 6 + [2] * 6:
        alone.learn(jobs, 0.02 + 0.001 * jobs, 0.02 + 0.001 * jobs)
        shared.learn(jobs, 0.3 + 0.02 + 0.001 * jobs, 0.02 + 0.001 * jobs)
    assert shared.chunk(80, 80, 1) == alone.chunk(80, 80, 1) > 3
    assert shared.patience > alone.patience or alone.patience == 1.0


def test_an_account_that_exceeds_the_wait_does_not_count() -> None:
    chunking = Chunking(SchedulerConfig())
    chunking.learn(2, 0.1, 1e9)
    assert chunking.median == pytest.approx(0.05)
