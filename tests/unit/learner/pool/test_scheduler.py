"""The scheduler's rules, one at a time: rounds, results, credits; `test_scheduler_simulation` tests
all together.
"""

import math

import pytest
from rounds import by_worker, started

from farm.errors import ConfigError
from learner.pool.job_table import JobTable
from learner.pool.scheduler import Scheduler, SchedulerConfig


def test_a_round_from_begin_to_complete():
    scheduler = started(3, ["a"], seconds=0.01)
    assert not scheduler.complete
    assert by_worker(scheduler.assign(0.0)) == {"a": [0, 1, 2]}
    assert (scheduler.remaining, scheduler.workers) == (3, {"a"})
    assert scheduler.results("a", [1, 0], 0.02) == ["new", "new"]
    assert scheduler.remaining == 1
    assert scheduler.results("a", [2], 0.03) == ["new"]
    assert scheduler.complete
    assert scheduler.assign(0.04) == []
    assert scheduler.next_deadline(0.04) is None
    assert scheduler.reissued == 0


def test_before_any_round_there_is_nothing():
    scheduler = Scheduler(SchedulerConfig())
    scheduler.want("a", 4, 0.0)
    assert not scheduler.complete
    assert scheduler.assign(0.0) == []
    assert scheduler.results("a", [0], 0.0) == ["stale"]
    assert not scheduler.error("a", 0, 0.0)
    assert (scheduler.remaining, scheduler.next_deadline(0.0)) == (0, None)


def test_a_round_without_jobs_is_complete():
    assert started(0, ["a"]).complete


def test_doubled_and_stale_results_do_not_count():
    scheduler = started(2, ["a"])
    scheduler.assign(0.0)
    assert scheduler.results("a", [0, 0, -1, 2], 0.1) == ["new", "doubled", "stale", "stale"]
    assert scheduler.remaining == 1


def test_results_count_of_workers_that_were_given_the_job_only():
    scheduler = started(2, ["a", "b"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    assert scheduler.results("stranger", [0, 1], 0.1) == ["unasked", "unasked"]
    assert scheduler.results("b", [0], 0.1) == ["unasked"]
    assert not scheduler.error("b", 0, 0.1)
    assert scheduler.results("a", [0], 0.1) == ["new"]
    assert scheduler.remaining == 1


def test_results_of_a_worker_that_was_given_nothing_may_be_of_an_earlier_round():
    scheduler = started(1, ["a", "b"])
    assert by_worker(scheduler.assign(0.0)) == {"a": [0]}
    assert (scheduler.unread("a"), scheduler.unread("b")) == (None, "unasked")
    for _ in range(2):
        scheduler.begin(1)
        assert (scheduler.unread("a"), scheduler.unread("b")) == ("stale", "unasked")
    scheduler.lost("a")
    assert scheduler.unread("a") == "unasked"


def test_a_worker_that_left_after_its_result_still_counts_and_the_job_is_not_sent_any_more():
    scheduler = started(2, ["a"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0]}
    assert scheduler.lost("a") == 1
    assert scheduler.results("a", [0], 0.1) == ["new"]
    scheduler.want("b", 4, 0.1)
    assert by_worker(scheduler.assign(0.1)) == {"b": [1]}


def test_jobs_that_are_reopened_are_done_again_by_others():
    scheduler = started(2, ["a"], credits=2)
    while not scheduler.complete:
        for _, indices in scheduler.assign(0.0):
            scheduler.results("a", list(indices), 0.1)
    scheduler.lost("a")
    scheduler.reopen([1], "a")
    assert not scheduler.complete
    assert scheduler.results("a", [1], 0.2) == ["unasked"]
    scheduler.want("b", 2, 0.2)
    assert by_worker(scheduler.assign(0.2)) == {"b": [1]}
    assert scheduler.results("b", [1], 0.3) == ["new"]
    assert scheduler.complete


def test_a_probe_that_is_reopened_is_given_once():
    table = JobTable(copies=1)
    table.begin(3)
    table.came("a", 9)
    table.prove("a")
    table.came("b", 9)
    table.asking["b"] = None
    assert table.probe("b", 0.0) == 2, "others may take it as well"
    table.finish("b", [2])
    table.left("b")
    table.reopen([2], "b")
    assert table.take("a", 9, 0.1) == (0, 1, 2)
    assert not table.any_pending()


def test_a_lost_worker_s_jobs_go_back_in_order():
    scheduler = started(6, ["a"], seconds=0.001)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0, 1, 2, 3]}
    scheduler.results("a", [1], 0.001)
    assert scheduler.lost("a") == 3
    assert scheduler.lost("a") == 0
    assert (scheduler.workers, scheduler.reissued) == (set(), 3)
    scheduler.want("b", 6, 0.2)
    assert by_worker(scheduler.assign(0.2)) == {"b": [0, 2, 3, 4, 5]}


def test_an_idle_worker_gets_its_jobs_again():
    scheduler = started(4, ["a"], seconds=0.001)
    scheduler.assign(0.0)
    assert scheduler.assign(0.5) == []
    scheduler.want("a", 4, 1.0, idle=True)
    assert by_worker(scheduler.assign(1.0)) == {"a": [0, 1, 2, 3]}
    assert scheduler.reissued == 4


def test_a_new_round_forgets_the_old_one_but_no_credits():
    scheduler = started(4, ["a"], seconds=0.001)
    scheduler.assign(0.0)
    scheduler.begin(3)
    assert by_worker(scheduler.assign(0.1)) == {"a": [0, 1, 2]}
    assert scheduler.lost("a") == 3


def test_seconds_per_job_count_from_when_the_worker_could_begin():
    scheduler = started(100, ["a"], credits=100)
    scheduler.assign(0.0)  # two jobs, one after the other
    scheduler.results("a", [0], 0.02)
    scheduler.results("a", [1], 0.04)
    scheduler.assign(0.04)
    assert scheduler._chunking.median == pytest.approx(0.02)


def test_credits_and_jobs_must_not_be_negative():
    scheduler = started(1)
    with pytest.raises(ValueError, match="credits of a is -1"):
        scheduler.want("a", -1, 0.0)
    with pytest.raises(ValueError, match="jobs is -1"):
        scheduler.begin(-1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("chunk_seconds", 0.0),
        ("chunk_seconds", math.nan),
        ("straggler_factor", 0.5),
        ("straggler_factor", "4"),
        ("straggler_seconds", -1.0),
        ("straggler_seconds", math.inf),
        ("copies", 0),
        ("copies", 1.5),
        ("max_errors", 0),
        ("max_errors", True),
    ],
)
def test_a_wrong_setting_is_named(name, value):
    with pytest.raises(ConfigError, match=name.replace("_", "-")):
        SchedulerConfig(**{name: value})
