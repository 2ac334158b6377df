"""The scheduler's rules: how many jobs a worker is given at once."""

from collections import Counter
from itertools import pairwise

from rounds import started

from learner.pool.scheduler import Assignment


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
    load = Counter[str]()
    for chunk in scheduler.assign(0.0):
        load[chunk.worker] += len(chunk.indices)
    assert Counter(load.values()) == {16: 41, 15: 23}
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
