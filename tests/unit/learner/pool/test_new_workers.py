"""The scheduler's rules: workers that have not answered yet."""

from collections import Counter

from rounds import by_worker, started


def test_a_new_worker_is_given_one_job_that_others_do_as_well():
    scheduler = started(40, ["a"], credits=8, seconds=0.01)
    first = by_worker(scheduler.assign(0.0))["a"]
    scheduler.results("a", first, 0.1)
    scheduler.want("b", 8, 0.1)
    jobs = by_worker(scheduler.assign(0.1))
    assert jobs["b"] == [39]
    scheduler.results("a", jobs["a"], 0.2)
    scheduler.results("b", [39], 0.2)
    assert len(by_worker(scheduler.assign(0.2))["b"]) > 1, "it has answered"
    assert 39 not in by_worker(scheduler.assign(0.2)).values()


def test_nobody_waits_for_workers_that_have_never_answered():
    silent = [f"liar/{i}" for i in range(100)]
    scheduler = started(40, ["a"], credits=99, seconds=0.01)
    scheduler.results("a", by_worker(scheduler.assign(0.0))["a"], 0.1)
    for worker in silent:
        scheduler.want(worker, 8, 0.1)
    assert scheduler.workers == {*silent, "a"}
    now, tries = 0.1, Counter()
    for _ in range(400):
        while not scheduler.complete:
            jobs = by_worker(scheduler.assign(now))
            now += 0.1
            assert jobs.pop("a", None), "there is always something to do"
            assert all(len(indices) == 1 for indices in jobs.values())
            tries.update(jobs.keys())
            scheduler.results("a", list(range(40)), now)
        scheduler.begin(40)
        for worker in silent:
            scheduler.want(worker, 8, now, idle=True)
    assert set(tries) == set(silent)
    assert set(tries.values()) == {2 * 6}, "the pauses between them double"
    assert scheduler.reissued == 0


def test_a_new_worker_that_answers_late_takes_part():
    scheduler = started(1, ["a"])
    scheduler.assign(0.0)
    scheduler.results("a", [0], 0.1)
    scheduler.want("b", 4, 0.1)
    assert by_worker(scheduler.assign(0.1)) == {"b": [0]}, (
        "a round that waits for checks only: a job that is done"
    )
    assert scheduler.results("b", [0], 0.2) == ["tried"]
    scheduler.want("c", 4, 0.2)
    scheduler.begin(2)
    assert by_worker(scheduler.assign(0.2)) == {"a": [0], "b": [1], "c": [1]}
    scheduler.begin(3)
    assert scheduler.unread("c") == "stale"
    assert by_worker(scheduler.assign(0.3)) == {"a": [0], "b": [1], "c": [2]}


def test_a_trial_that_came_too_late_is_repeated_when_the_next_round_begins():
    scheduler = started(1, ["a"])
    scheduler.results("a", by_worker(scheduler.assign(0.0))["a"], 0.1)
    scheduler.want("b", 4, 0.1)
    for _ in range(2):
        assert by_worker(scheduler.assign(0.1))["b"] == [0]
        scheduler.begin(1)
    assert "b" not in by_worker(scheduler.assign(0.1)), "it is to ask again"
    scheduler.want("b", 4, 0.2, idle=True)
    assert by_worker(scheduler.assign(0.2))["b"] == [0]


def test_when_those_that_answered_have_left_new_workers_take_part():
    scheduler = started(2, ["a"], credits=1)
    scheduler.results("a", by_worker(scheduler.assign(0.0))["a"], 0.1)
    scheduler.want("b", 4, 0.1)
    scheduler.lost("a")
    assert by_worker(scheduler.assign(0.2)) == {"b": [1]}
    assert scheduler.next_deadline(0.2) is not None, "not a trial"


def test_the_next_trial_is_another_job():
    """A device that can do no rollout of the mean policy, the last job, is not given it again."""
    scheduler = started(40, ["a"], credits=8, seconds=0.01)
    scheduler.results("a", by_worker(scheduler.assign(0.0))["a"], 0.1)
    given = []
    now = 0.1
    for _ in range(2):
        scheduler.begin(40)
        scheduler.want("b", 8, now, idle=True)
        given += by_worker(scheduler.assign(now))["b"]
        scheduler.error("b", given[-1], now)
        now += 10.0
    assert given == [39, 38]
