"""The scheduler's rules, one at a time; `test_scheduler_simulation` tests them together."""

import math
from collections import Counter
from itertools import pairwise

import pytest

from farm.errors import ConfigError
from learner.scheduler.scheduler import Assignment, Scheduler, SchedulerConfig


def started(jobs, workers=(), *, credits=4, seconds=None, **config):
    """Return a scheduler in a round of `jobs`; `seconds` per job are known from an earlier round."""
    scheduler = Scheduler(SchedulerConfig(**{"chunk_seconds": 0.08, "short_seconds": 0.0, **config}))
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


def given(chunks):
    """Return the jobs by worker."""
    jobs = {}
    for worker, indices in chunks:
        jobs.setdefault(worker, []).extend(indices)
    return jobs


def test_a_round_from_begin_to_complete():
    scheduler = started(3, ["a"], seconds=0.01)
    assert not scheduler.complete
    assert given(scheduler.assign(0.0)) == {"a": [0, 1, 2]}
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
    assert given(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    assert scheduler.results("stranger", [0, 1], 0.1) == ["unasked", "unasked"]
    assert scheduler.results("b", [0], 0.1) == ["unasked"]
    assert not scheduler.error("b", 0, 0.1)
    assert scheduler.results("a", [0], 0.1) == ["new"]
    assert scheduler.remaining == 1


def test_results_of_a_worker_that_was_given_nothing_may_be_of_an_earlier_round():
    scheduler = started(1, ["a", "b"])
    assert given(scheduler.assign(0.0)) == {"a": [0]}
    assert (scheduler.unread("a"), scheduler.unread("b")) == (None, "unasked")
    for _ in range(2):
        scheduler.begin(1)
        assert (scheduler.unread("a"), scheduler.unread("b")) == ("stale", "unasked")
    scheduler.lost("a")
    assert scheduler.unread("a") == "unasked"


def test_a_worker_that_left_after_its_result_still_counts_and_the_job_is_not_sent_any_more():
    scheduler = started(2, ["a"], credits=1)
    assert given(scheduler.assign(0.0)) == {"a": [0]}
    assert scheduler.lost("a") == 1
    assert scheduler.results("a", [0], 0.1) == ["new"]
    scheduler.want("b", 4, 0.1)
    assert given(scheduler.assign(0.1)) == {"b": [1]}


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
    assert given(scheduler.assign(0.2)) == {"b": [1]}
    assert scheduler.results("b", [1], 0.3) == ["new"]
    assert scheduler.complete


def test_an_unknown_duration_is_probed_one_job_at_a_time():
    scheduler = started(100, ["a", "b"], credits=50)
    assert scheduler.assign(0.0) == [
        Assignment("a", (0,)),
        Assignment("b", (1,)),
        Assignment("a", (2,)),
        Assignment("b", (3,)),
    ]


def test_chunks_follow_the_duration_and_hold_two_each():
    scheduler = started(1000, ["a", "b"], credits=500, seconds=0.01)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [8, 8, 8, 8]
    scheduler.results("a", range(8), 0.08)
    assert [(w, len(i)) for w, i in scheduler.assign(0.08)] == [("a", 8)]


def test_answers_one_by_one_are_not_followed_by_chunks_of_one():
    scheduler = started(1000, ["a"], credits=500, seconds=0.01)
    scheduler.assign(0.0)
    for index in range(7):
        scheduler.results("a", [index], 0.01 * (index + 1))
        assert scheduler.assign(0.01 * (index + 1)) == []
    scheduler.results("a", [7], 0.08)
    assert len(scheduler.assign(0.08)[0].indices) == 8


def test_chunks_shrink_towards_the_end():
    scheduler = started(40, ["a", "b"], credits=100, seconds=0.001, least_seconds=1e-6)
    chunks, sizes = scheduler.assign(0.0), []
    while chunks:  # each answers its oldest chunk in turn
        chunk, *chunks = chunks
        sizes.append(len(chunk.indices))
        scheduler.results(chunk.worker, chunk.indices, 0.001)
        chunks += scheduler.assign(0.001)
    assert sum(sizes) == 40
    assert sizes[0] == 10
    assert all(later <= before for before, later in pairwise(sizes))


def test_chunks_do_not_shrink_below_what_is_worth_a_message():
    scheduler = started(40, ["a", "b"], credits=100, seconds=0.001, least_seconds=0.008)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [10, 10, 10, 10]
    scheduler = started(20, ["a", "b"], credits=100, seconds=0.001, least_seconds=0.008)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [8, 8, 2, 2]
    scheduler = started(6, ["a", "b"], credits=100, seconds=0.001, least_seconds=0.008)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [3, 3]


def test_a_short_round_is_not_cut():
    scheduler = started(31, ["a", "b"], credits=100, seconds=0.003, short_seconds=0.06)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [16, 15]
    scheduler = started(42, ["a", "b"], credits=100, seconds=0.003, short_seconds=0.06)
    assert [len(chunk.indices) for chunk in scheduler.assign(0.0)] == [11, 11, 10, 10]


def test_chunks_grow_with_the_farm_and_so_does_patience():
    names = [f"w{i:03}" for i in range(600)]
    scheduler = started(60_000, names, credits=128, seconds=0.02, chunk_seconds=0.2)
    assert scheduler.patience == 1.0
    assert {len(chunk.indices) for chunk in scheduler.assign(0.0)} == {50}
    assert scheduler.patience == 4.0
    assert scheduler.next_deadline(0.0) == 4.0


def test_what_is_left_after_the_first_chunks_is_dealt_evenly():
    names = [f"w{i:02}" for i in range(64)]
    scheduler = started(1001, names, credits=128, seconds=0.02, chunk_seconds=0.2)
    held = Counter[str]()
    for chunk in scheduler.assign(0.0):
        held[chunk.worker] += len(chunk.indices)
    assert Counter(held.values()) == {16: 41, 15: 23}
    scheduler = started(17, ["a", "b"], credits=128, seconds=0.004, least_seconds=0.015)
    assert [(chunk.worker, len(chunk.indices)) for chunk in scheduler.assign(0.0)] == [
        ("a", 5),
        ("b", 5),
        ("a", 4),
        ("b", 3),
    ]


def test_credits_are_the_limit_and_two_chunks_fit_into_them():
    scheduler = started(1000, ["a"], credits=5, seconds=0.001)
    assert scheduler.assign(0.0) == [Assignment("a", (0, 1, 2)), Assignment("a", (3, 4))]
    scheduler.want("a", 0, 0.0)
    scheduler.results("a", range(5), 0.1)
    assert scheduler.assign(0.1) == []


def test_those_with_the_fewest_jobs_come_first_then_by_name():
    scheduler = started(5, ["c", "b", "a"], credits=2)
    assert [chunk.worker for chunk in scheduler.assign(0.0)] == ["a", "b", "c", "a", "b"]


def test_a_lost_worker_s_jobs_go_back_in_order():
    scheduler = started(6, ["a"], seconds=0.001)
    assert given(scheduler.assign(0.0)) == {"a": [0, 1, 2, 3]}
    scheduler.results("a", [1], 0.001)
    assert scheduler.lost("a") == 3
    assert scheduler.lost("a") == 0
    assert (scheduler.workers, scheduler.reissued) == (set(), 3)
    scheduler.want("b", 6, 0.2)
    assert given(scheduler.assign(0.2)) == {"b": [0, 2, 3, 4, 5]}


def test_an_idle_worker_gets_its_jobs_again():
    scheduler = started(4, ["a"], seconds=0.001)
    scheduler.assign(0.0)
    assert scheduler.assign(0.5) == []
    scheduler.want("a", 4, 1.0, idle=True)
    assert given(scheduler.assign(1.0)) == {"a": [0, 1, 2, 3]}
    assert scheduler.reissued == 4


def test_a_new_round_forgets_the_old_one_but_no_credits():
    scheduler = started(4, ["a"], seconds=0.001)
    scheduler.assign(0.0)
    scheduler.begin(3)
    assert given(scheduler.assign(0.1)) == {"a": [0, 1, 2]}
    assert scheduler.lost("a") == 3


def test_a_straggler_is_copied_to_another_worker():
    scheduler = started(1, ["a"], seconds=0.001)
    assert given(scheduler.assign(0.0)) == {"a": [0]}
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
    assert given(scheduler.assign(5.0)) == {"b": [2, 3]}


def test_an_error_is_tried_elsewhere_and_the_third_worker_stops_the_run():
    scheduler = started(1, ["a", "b", "c"])
    assert given(scheduler.assign(0.0)) == {"a": [0]}
    assert not scheduler.error("a", 0, 0.1)
    assert not scheduler.error("a", 0, 0.1)  # the same message again
    assert given(scheduler.assign(0.1)) == {"b": [0]}
    assert not scheduler.error("b", 0, 0.2)
    assert given(scheduler.assign(0.2)) == {"c": [0]}
    assert scheduler.reissued == 2
    assert scheduler.error("c", 0, 0.3)


def test_with_fewer_workers_the_answers_count():
    scheduler = started(1, ["a"])
    for answer in range(3):
        assert given(scheduler.assign(0.1 * answer)) == {"a": [0]}
        assert scheduler.error("a", 0, 0.1 * answer) == (answer == 2)


def test_machines_that_lack_something_do_not_end_a_run_that_others_serve():
    scheduler = started(30, ["a/1", "b/1", "c/1", "good/1"], credits=2)
    for now in range(1, 60):
        for name, indices in given(scheduler.assign(0.01 * now)).items():
            for index in indices:
                if name == "good/1":
                    scheduler.results(name, [index], 0.01 * now)
                else:
                    assert not scheduler.error(name, index, 0.01 * now)
        for name in ("a/1", "b/1", "c/1"):
            scheduler.want(name, 2, 0.01 * now, idle=True)
    assert scheduler.complete


def test_hosts_that_cannot_build_the_task_count_against_no_job():
    scheduler = started(2, ["bad/1", "bad/2"], credits=2)
    for now in (0.1, 0.2):
        for name, _ in scheduler.assign(now):
            assert scheduler.refused(name) > 0
    assert not scheduler.workers
    assert not scheduler.error("bad/1", 0, 0.3), "nothing of it is heard any more"
    scheduler.want("good/1", 2, 0.4)
    assert given(scheduler.assign(0.4)) == {"good/1": [0, 1]}
    assert scheduler.results("good/1", [0, 1], 0.5) == ["new", "new"]
    assert scheduler.complete


def test_errors_of_a_host_that_is_refused_later_do_not_count():
    scheduler = started(1, ["bad/1"])
    for now in (0.1, 0.2):
        assert given(scheduler.assign(now)) == {"bad/1": [0]}
        assert not scheduler.error("bad/1", 0, now)
    scheduler.refused("bad/1")
    scheduler.want("good/1", 1, 0.3)
    assert given(scheduler.assign(0.3)) == {"good/1": [0]}
    assert not scheduler.error("good/1", 0, 0.4), "its first error is the only one"


def test_processes_of_one_host_are_one_opinion():
    names = ["h/1", "h/2", "h/3", "i/1"]
    scheduler = started(5, names, credits=1)
    for name, [index] in given(scheduler.assign(0.0)).items():
        scheduler.results(name, [index], 0.1)  # all can, in principle
    for now in (0.2, 0.3, 0.4):
        [(name, [index])] = given(scheduler.assign(now)).items()
        assert name.startswith("h/")
        assert not scheduler.error(name, index, now)
    assert given(scheduler.assign(0.5)) == {"i/1": [4]}
    assert scheduler.error("i/1", 4, 0.6), "no worker is left to try"


def test_three_hosts_that_brought_results_are_enough():
    scheduler = started(6, ["a/1", "b/1", "c/1", "d/1", "e/1"], credits=1)
    for name, [index] in given(scheduler.assign(0.0)).items():
        scheduler.results(name, [index], 0.1)
    failed = []
    for now in (0.2, 0.3, 0.4):
        [(name, [index])] = given(scheduler.assign(now)).items()
        failed.append(scheduler.error(name, index, now))
    assert failed == [False, False, True]


def test_a_worker_that_failed_gets_nothing_until_it_speaks():
    scheduler = started(8, ["a", "b"], credits=1)
    assert given(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.error("a", 0, 0.1)
    scheduler.results("b", [1], 0.1)
    assert given(scheduler.assign(0.1)) == {"b": [0]}
    scheduler.results("b", [0], 0.2)
    assert given(scheduler.assign(0.2)) == {"b": [2]}
    scheduler.want("a", 1, 0.3, idle=True)
    assert given(scheduler.assign(0.3)) == {"a": [3]}


def test_strangers_failures_count_for_nothing():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    assert not any(scheduler.error(name, 0, 0.1) for name in ("x", "y", "z"))
    assert scheduler.reissued == 0


def test_a_worker_that_hung_at_the_end_of_a_round_is_not_waited_for_again():
    scheduler = started(2, ["a", "b"], credits=1)
    assert given(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.results("b", [1], 0.1)
    assert given(scheduler.assign(1.0)) == {"b": [0]}  # a is late
    scheduler.results("b", [0], 1.1)
    scheduler.begin(2)
    assert given(scheduler.assign(1.1)) == {"b": [0]}
    scheduler.results("b", [0], 1.2)
    assert given(scheduler.assign(1.2)) == {"b": [1]}
    assert scheduler.unread("a") == "stale", "results of the round gone by: it lives"
    scheduler.begin(2)
    assert given(scheduler.assign(1.4)) == {"a": [0], "b": [1]}


def test_no_copy_goes_to_a_worker_that_is_late_and_has_never_answered():
    scheduler = started(3, ["a", "s1", "s2"], credits=1)
    assert given(scheduler.assign(0.0)) == {"a": [0], "s1": [1], "s2": [2]}
    scheduler.results("a", [0], 0.1)
    for silent in ("s1", "s2"):
        scheduler.want(silent, 9, 0.2)
    assert given(scheduler.assign(1.0)) == {"a": [1]}
    assert scheduler.assign(1.05) == [], "a has no room, the silent ones have"
    scheduler.results("a", [1], 1.1)
    assert given(scheduler.assign(1.1)) == {"a": [2]}


def test_the_last_worker_is_asked_again():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    scheduler.error("a", 0, 5.0)
    assert given(scheduler.assign(5.0)) == {"a": [0]}


def test_a_failed_job_waits_for_another_worker_but_not_for_ever():
    scheduler = started(3, ["a", "b"], credits=1)
    assert given(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.error("a", 0, 0.1)
    scheduler.want("a", 1, 0.1)
    assert given(scheduler.assign(0.1)) == {"a": [2]}
    scheduler.results("a", [2], 0.2)
    assert scheduler.assign(0.2) == []  # b has no room, a failed at it
    assert scheduler.next_deadline(0.2) == pytest.approx(0.8)  # job 1 is late at 1.0
    assert given(scheduler.assign(1.0)) == {"a": [1]}
    scheduler.want("a", 2, 1.0)
    assert scheduler.assign(1.0) == []
    assert scheduler.next_deadline(1.0) == pytest.approx(0.1)
    assert given(scheduler.assign(1.11)) == {"a": [0]}


def test_an_error_for_a_job_that_is_done_or_copied_is_no_reissue():
    scheduler = started(1, ["a", "b", "c"])
    scheduler.assign(0.0)
    scheduler.assign(1.0)
    assert not scheduler.error("a", 0, 1.1)
    assert scheduler.reissued == 1
    scheduler.results("b", [0], 1.2)
    assert not scheduler.error("c", 0, 1.3)
    assert not scheduler.error("c", 7, 1.3)


def test_seconds_per_job_count_from_when_the_worker_could_begin():
    scheduler = started(100, ["a"], credits=100)
    scheduler.assign(0.0)  # two jobs, one after the other
    scheduler.results("a", [0], 0.02)
    scheduler.results("a", [1], 0.04)
    scheduler.assign(0.04)
    assert scheduler._chunking.median == pytest.approx(0.02)


def test_a_job_that_is_repeated_counts_as_work_of_its_worker():
    scheduler = started(8, ["a", "b"], seconds=0.01, short_seconds=1.0, credits=8)
    scheduler.begin(6)
    assert given(scheduler.assign(0.0)) == {"a": [0, 1, 2], "b": [3, 4, 5]}
    assert not scheduler.half_done
    assert scheduler.results("a", [0, 1, 2], 0.03) == ["new"] * 3
    assert scheduler.half_done
    assert scheduler.willing == ["a", "b"]
    scheduler.lend("a", [3, 4, 5, 0])
    assert scheduler.willing == ["b", "a"]
    assert scheduler.results("b", [3, 4, 5], 0.04) == ["new"] * 3
    assert scheduler.results("a", [0, 3, 4, 5], 0.07) == ["doubled"] * 4
    assert scheduler.willing == ["a", "b"]


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


def test_a_new_worker_is_given_one_job_that_others_do_as_well():
    scheduler = started(40, ["a"], credits=8, seconds=0.01)
    first = given(scheduler.assign(0.0))["a"]
    scheduler.results("a", first, 0.1)
    scheduler.want("b", 8, 0.1)
    jobs = given(scheduler.assign(0.1))
    assert jobs["b"] == [39]
    scheduler.results("a", jobs["a"], 0.2)
    scheduler.results("b", [39], 0.2)
    assert len(given(scheduler.assign(0.2))["b"]) > 1, "it has answered"
    assert 39 not in given(scheduler.assign(0.2)).values()


def test_nobody_waits_for_workers_that_have_never_answered():
    silent = [f"liar/{i}" for i in range(100)]
    scheduler = started(40, ["a"], credits=99, seconds=0.01)
    scheduler.results("a", given(scheduler.assign(0.0))["a"], 0.1)
    for worker in silent:
        scheduler.want(worker, 8, 0.1)
    assert scheduler.workers == {*silent, "a"}
    now, tried = 0.1, Counter()
    for _ in range(400):
        while not scheduler.complete:
            jobs = given(scheduler.assign(now))
            now += 0.1
            assert jobs.pop("a", None), "there is always something to do"
            assert all(len(indices) == 1 for indices in jobs.values())
            tried.update(jobs.keys())
            scheduler.results("a", list(range(40)), now)
        scheduler.begin(40)
        for worker in silent:
            scheduler.want(worker, 8, now, idle=True)
    assert set(tried) == set(silent)
    assert set(tried.values()) == {2 * 6}, "the pauses between them double"
    assert scheduler.reissued == 0


def test_a_new_worker_that_answers_late_takes_part():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    scheduler.results("a", [0], 0.1)
    scheduler.want("b", 4, 0.1)
    assert given(scheduler.assign(0.1)) == {"b": [0]}, "a round that waits for checks only: a job that is done"
    assert scheduler.results("b", [0], 0.2) == ["tried"]
    scheduler.want("c", 4, 0.2)
    scheduler.begin(2)
    assert given(scheduler.assign(0.2)) == {"a": [0], "b": [1], "c": [1]}
    scheduler.begin(3)
    assert scheduler.unread("c") == "stale"
    assert given(scheduler.assign(0.3)) == {"a": [0], "b": [1], "c": [2]}


def test_a_trial_that_came_too_late_is_repeated_when_the_next_round_begins():
    scheduler = started(1, ["a"])
    scheduler.results("a", given(scheduler.assign(0.0))["a"], 0.1)
    scheduler.want("b", 4, 0.1)
    for _ in range(2):
        assert given(scheduler.assign(0.1))["b"] == [0]
        scheduler.begin(1)
    assert "b" not in given(scheduler.assign(0.1)), "it is to ask again"
    scheduler.want("b", 4, 0.2, idle=True)
    assert given(scheduler.assign(0.2))["b"] == [0]


def test_when_those_that_answered_have_left_new_workers_take_part():
    scheduler = started(2, ["a"], credits=1)
    scheduler.results("a", given(scheduler.assign(0.0))["a"], 0.1)
    scheduler.want("b", 4, 0.1)
    scheduler.lost("a")
    assert given(scheduler.assign(0.2)) == {"b": [1]}
    assert scheduler.next_deadline(0.2) is not None, "not a trial"
