"""The scheduler's rules: jobs that fail, and workers that fail at them."""

import pytest
from rounds import by_worker, started


def test_an_error_is_tried_elsewhere_and_the_third_worker_stops_the_run():
    scheduler = started(1, ["a", "b", "c"])
    assert by_worker(scheduler.assign(0.0)) == {"a": [0]}
    assert not scheduler.error("a", 0, 0.1)
    assert not scheduler.error("a", 0, 0.1)  # the same message again
    assert by_worker(scheduler.assign(0.1)) == {"b": [0]}
    assert not scheduler.error("b", 0, 0.2)
    assert by_worker(scheduler.assign(0.2)) == {"c": [0]}
    assert scheduler.reissued == 2
    assert scheduler.error("c", 0, 0.3)


def test_with_fewer_workers_the_answers_count():
    scheduler = started(1, ["a"])
    for answer in range(3):
        assert by_worker(scheduler.assign(0.1 * answer)) == {"a": [0]}
        assert scheduler.error("a", 0, 0.1 * answer) == (answer == 2)


def test_machines_that_lack_something_do_not_end_a_run_that_others_serve():
    scheduler = started(30, ["a/1", "b/1", "c/1", "good/1"], credits=2)
    for now in range(1, 60):
        for name, indices in by_worker(scheduler.assign(0.01 * now)).items():
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
            assert scheduler.declined(name) > 0
    assert not scheduler.workers
    assert not scheduler.error("bad/1", 0, 0.3), "nothing of it is heard any more"
    scheduler.want("good/1", 2, 0.4)
    assert by_worker(scheduler.assign(0.4)) == {"good/1": [0, 1]}
    assert scheduler.results("good/1", [0, 1], 0.5) == ["new", "new"]
    assert scheduler.complete


def test_errors_of_a_host_that_is_refused_later_do_not_count():
    scheduler = started(1, ["bad/1"])
    for now in (0.1, 0.2):
        assert by_worker(scheduler.assign(now)) == {"bad/1": [0]}
        assert not scheduler.error("bad/1", 0, now)
    scheduler.declined("bad/1")
    scheduler.want("good/1", 1, 0.3)
    assert by_worker(scheduler.assign(0.3)) == {"good/1": [0]}
    assert not scheduler.error("good/1", 0, 0.4), "its first error is the only one"


def test_processes_of_one_host_are_one_opinion():
    names = ["h/1", "h/2", "h/3", "i/1"]
    scheduler = started(5, names, credits=1)
    for name, [index] in by_worker(scheduler.assign(0.0)).items():
        scheduler.results(name, [index], 0.1)  # all can, in principle
    for now in (0.2, 0.3, 0.4):
        [(name, [index])] = by_worker(scheduler.assign(now)).items()
        assert name.startswith("h/")
        assert not scheduler.error(name, index, now)
    assert by_worker(scheduler.assign(0.5)) == {"i/1": [4]}
    assert scheduler.error("i/1", 4, 0.6), "no worker is left to try"


def test_three_hosts_that_brought_results_are_enough():
    scheduler = started(6, ["a/1", "b/1", "c/1", "d/1", "e/1"], credits=1)
    for name, [index] in by_worker(scheduler.assign(0.0)).items():
        scheduler.results(name, [index], 0.1)
    failed = []
    for now in (0.2, 0.3, 0.4):
        [(name, [index])] = by_worker(scheduler.assign(now)).items()
        failed.append(scheduler.error(name, index, now))
    assert failed == [False, False, True]


def test_a_worker_that_failed_gets_nothing_until_it_speaks():
    scheduler = started(8, ["a", "b"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.error("a", 0, 0.1)
    scheduler.results("b", [1], 0.1)
    assert by_worker(scheduler.assign(0.1)) == {"b": [0]}
    scheduler.results("b", [0], 0.2)
    assert by_worker(scheduler.assign(0.2)) == {"b": [2]}
    scheduler.want("a", 1, 0.3, idle=True)
    assert by_worker(scheduler.assign(0.3)) == {"a": [3]}


def test_strangers_failures_count_for_nothing():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    assert not any(scheduler.error(name, 0, 0.1) for name in ("x", "y", "z"))
    assert scheduler.reissued == 0


def test_a_failed_job_waits_for_another_worker_but_not_for_ever():
    scheduler = started(3, ["a", "b"], credits=1)
    assert by_worker(scheduler.assign(0.0)) == {"a": [0], "b": [1]}
    scheduler.error("a", 0, 0.1)
    scheduler.want("a", 1, 0.1)
    assert by_worker(scheduler.assign(0.1)) == {"a": [2]}
    scheduler.results("a", [2], 0.2)
    assert scheduler.assign(0.2) == []  # b has no room, a failed at it
    assert scheduler.next_deadline(0.2) == pytest.approx(0.8)  # job 1 is late at 1.0
    assert by_worker(scheduler.assign(1.0)) == {"a": [1]}
    scheduler.want("a", 2, 1.0)
    assert scheduler.assign(1.0) == []
    assert scheduler.next_deadline(1.0) == pytest.approx(0.1)
    assert by_worker(scheduler.assign(1.11)) == {"a": [0]}


def test_an_error_for_a_job_that_is_done_or_copied_is_no_reissue():
    scheduler = started(1, ["a", "b", "c"])
    scheduler.assign(0.0)
    scheduler.assign(1.0)
    assert not scheduler.error("a", 0, 1.1)
    assert scheduler.reissued == 1
    scheduler.results("b", [0], 1.2)
    assert not scheduler.error("c", 0, 1.3)
    assert not scheduler.error("c", 7, 1.3)
