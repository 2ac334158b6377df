"""The scheduler's rules: jobs of late workers, which others do as well."""

import pytest
from rounds import by_worker, started

from learner.pool.scheduler import Assignment


def test_a_straggler_is_copied_to_another_worker():
    scheduler = started(1, ["a"], seconds=0.001)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0]}
    scheduler.want("b", 1, 0.1)
    assert scheduler.assign(0.1) == []
    assert scheduler.next_deadline(0.1) == pytest.approx(0.9)
    assert scheduler.assign(1.0) == [Assignment("b", (0,))]
    assert scheduler.reissued == 1
    assert scheduler.results("b", [0], 1.1) == ["new"]
    assert scheduler.complete
    assert scheduler.results("a", [0], 1.2) == ["doubled"]


def test_slow_jobs_are_given_several_medians():
    scheduler = started(1, ["a", "b"], seconds=2.0)
    scheduler.assign(0.0)
    assert scheduler.next_deadline(0.0) == pytest.approx(8.0)
    assert scheduler.assign(7.9) == []
    assert scheduler.assign(8.0) == [Assignment("b", (0,))]


def test_copies_are_limited_and_then_the_oldest_is_given_up():
    scheduler = started(1, ["a", "b", "c", "d", "e"])
    holders = []
    for now in (0.0, 1.0, 2.0, 3.0, 11.9):
        holders += [chunk.worker for chunk in scheduler.assign(now)]
    assert holders == ["a", "b", "c"]
    assert scheduler.next_deadline(11.9) == pytest.approx(0.1)
    assert scheduler.assign(12.0) == [Assignment("d", (0,))]
    assert scheduler.results("a", [0], 12.5) == ["new"]


def test_a_copy_lost_with_its_worker_leaves_the_others():
    scheduler = started(1, ["a", "b", "c", "d"])
    for now in (0.0, 1.0, 2.0):
        scheduler.assign(now)
    assert scheduler.lost("a") == 0
    assert scheduler.assign(2.5) == []
    assert scheduler.assign(3.0) == [Assignment("d", (0,))]
    assert [scheduler.lost(worker) for worker in "bcd"] == [0, 0, 1]


def test_a_worker_does_not_get_a_job_twice_and_there_is_no_busy_loop():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    assert scheduler.assign(1.0) == []
    assert scheduler.next_deadline(1.0) is None  # only news can help
    scheduler.want("b", 1, 1.5)
    assert scheduler.next_deadline(1.5) == 0.0
    assert scheduler.assign(1.5) == [Assignment("b", (0,))]


def test_nothing_is_copied_while_jobs_are_pending():
    scheduler = started(9, ["a"], credits=2)
    scheduler.assign(0.0)
    scheduler.want("b", 2, 5.0)
    assert by_worker(scheduler.assign(5.0)) == {"b": [2, 3]}


def test_a_worker_that_hung_at_the_end_of_a_round_is_not_waited_for_again():
    scheduler = started(2, ["a", "b"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.results("b", [1], 0.1)
    assert by_worker(scheduler.assign(1.0)) == {"b": [0]}  # a is late
    scheduler.results("b", [0], 1.1)
    scheduler.begin(2)
    assert by_worker(scheduler.assign(1.1)) == {"b": [0]}
    scheduler.results("b", [0], 1.2)
    assert by_worker(scheduler.assign(1.2)) == {"b": [1]}
    assert scheduler.unread("a") == "stale", "results of the round gone by: it lives"
    scheduler.begin(2)
    assert by_worker(scheduler.assign(1.4)) == {"a": [0], "b": [1]}


def test_no_copy_goes_to_a_worker_that_is_late_and_has_never_answered():
    scheduler = started(3, ["a", "s1", "s2"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0], "s1": [1], "s2": [2]}
    scheduler.results("a", [0], 0.1)
    for silent in ("s1", "s2"):
        scheduler.want(silent, 9, 0.2)
    assert by_worker(scheduler.assign(1.0)) == {"a": [1]}
    assert scheduler.assign(1.05) == [], "a has no room, the silent ones have"
    scheduler.results("a", [1], 1.1)
    assert by_worker(scheduler.assign(1.1)) == {"a": [2]}


def test_the_last_worker_is_asked_again():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    scheduler.error("a", 0, 5.0)
    assert by_worker(scheduler.assign(5.0)) == {"a": [0]}
