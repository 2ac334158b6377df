"""A run's reports: in order, in pages, in bounded memory."""

import itertools
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from made import stats

from farm.net import codec
from farm.net.telemetry import Report, RunHistory
from learner.telemetry.report_log import ReportLog

TRACE = 15 * 54 * 4  # bytes of one trace


def report(generation: int, rollouts: int = 1) -> Report:
    values = np.full((rollouts, 15, 54), generation, "<f4")
    traces = {"all": values} if rollouts else {}
    return Report(incarnation="i", progress=stats(generation), rate=1.0, traces=traces)


def filled(generations: int, memory: int, page: int) -> ReportLog:
    def earlier(first: int) -> Iterator[Report]:
        return (
            report(generation, rollouts=0) for generation in range(max(first, 1), generations + 1)
        )

    history = ReportLog(earlier, memory, page)
    for generation in range(1, generations + 1):
        history.add(report(generation))
    return history


def pages_of(history: ReportLog, first: int = 1) -> list[list[Report]]:
    """Pages, as a recorder asks for them."""
    pages = []
    while page := history.page(first):
        pages.append(list(page))
        first = page[-1].generation + 1
    return pages


def test_every_generation_once_and_in_order() -> None:
    pages = pages_of(filled(100, memory=1 << 20, page=10_000))
    assert [r.generation for page in pages for r in page] == list(range(1, 101))
    assert len(pages) > 10
    assert max(len(codec.encode(tuple_of(page))) for page in pages) < 3 * 10_000


def tuple_of(page: list[Report]) -> object:
    return RunHistory(
        run="r",
        incarnation="i",
        recording="r",
        config={},
        files={},
        generation=100,
        reports=tuple(page),
        end=None,
    )


def test_the_oldest_rollouts_go_and_no_statistics() -> None:
    reports = list(itertools.chain(*pages_of(filled(50, memory=10 * TRACE + 10_000, page=1 << 20))))
    assert [r.generation for r in reports] == list(range(1, 51))
    assert [r.generation for r in reports if r.traces] == list(range(41, 51))
    assert all(r.progress == stats(r.generation) for r in reports)


def test_one_report_larger_than_everything() -> None:
    history = filled(4, memory=4 * TRACE, page=TRACE)
    history.add(report(4, rollouts=100))
    assert [r.generation for page in pages_of(history) for r in page] == [1, 2, 3, 4]
    assert not history.page(4)[0].traces
    assert len(ReportLog(memory=0, page=0).page(1)) == 0


def test_what_is_kept_takes_the_memory_that_counts() -> None:
    reports = [report(generation, rollouts=0) for generation in range(1, 3001)]
    history = ReportLog(memory=1 << 20)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for each in reports:
            history.add(each)
        taken = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert 0.7 * (1 << 20) < taken < 1.3 * (1 << 20)
    [oldest, *_], newest = history.page(1), history.page(3000)[-1]
    assert 1000 < oldest.generation < 3000
    assert newest.generation == 3000
    assert (
        0.5
        < sum(each.nbytes for each in reports) / 3000 / (taken / (3001 - oldest.generation))
        < 2.0
    )


@pytest.mark.parametrize("first", [-5, 0, 1])
def test_from_the_start(first: int) -> None:
    assert [r.generation for r in filled(3, 1 << 20, 1 << 20).page(first)] == [1, 2, 3]


def test_generations_that_a_folder_lost() -> None:
    history = ReportLog()
    for generation in (1, 2, 7, 8, 9):
        history.add(report(generation, rollouts=0))
    assert [r.generation for r in history.page(3)] == [7, 8, 9]
    assert [r.generation for r in history.page(8)] == [8, 9]
    assert history.page(10) == ()
