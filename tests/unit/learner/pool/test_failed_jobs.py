"""Jobs that fail, and workers that cannot serve a run: what the learner makes of it; no physics."""

import queue
import threading
import time

import pytest
from doubles import (
    WAIT,
    Hire,
    Learner,
    Worker,
    done,
    jobs,
)

from farm.errors import RunError
from farm.net import codec
from farm.net.work import Chunk


@pytest.mark.parametrize("workers", [1, 3])
def test_a_job_that_fails_everywhere(learner: Learner, hire: Hire, workers: int) -> None:
    learner.show()
    hands = [hire(f"w{i}/1") for i in range(workers)]
    for hand in hands:
        hand.want(1)
    collected = learner.collect(jobs(1))
    turn: queue.SimpleQueue[None] = queue.SimpleQueue()

    def fail(hand: Worker) -> None:
        while True:
            try:
                event = hand.session.events.get(timeout=0.05)
            except queue.Empty:
                if collected.done():
                    return
                continue
            if event.topic == "inbox":
                chunk = codec.decode(event.payload, Chunk)
                turn.put(None)
                text = f"OverflowError: too much for {hand.name}"
                hand.answer(hand.failure(chunk, 0, text))

    threads = [threading.Thread(target=fail, args=(hand,)) for hand in hands]
    for thread in threads:
        thread.start()
    words = r"job 0 of generation 0 \(seed \(3, 0, 4, 0\)\) failed .*OverflowError: too much"
    with pytest.raises(RunError, match=words):
        collected.result(WAIT)
    for thread in threads:
        thread.join()
    assert turn.qsize() == 3


@pytest.mark.parametrize("any_rounding", [False, True])
def test_what_the_checker_can_simulate_says_nothing_of_a_device(
    learner: Learner, hire: Hire, any_rounding: bool
) -> None:
    pool = learner.show(checked=True, any_rounding=any_rounding)
    failing, good = [hire(f"w{i}/1") for i in range(3)], hire("good/1")
    collected = learner.collect(jobs(1))
    for hand in failing:
        hand.want(1)
    until = time.monotonic() + WAIT
    while len(pool.workers) < 3:
        assert time.monotonic() < until
    while pool.workers and not collected.done():
        assert time.monotonic() < until
        for hand in failing:
            for event in hand.session.events.waiting(0.01):
                if event.topic == "inbox":
                    chunk = codec.decode(event.payload, Chunk)
                    hand.answer(hand.failure(chunk, 0, "RuntimeError: the motor is hot"))
    if any_rounding:
        with pytest.raises(RunError, match="the motor is hot"):
            collected.result(WAIT)
        return
    good.want(1)
    good.work(1)
    assert done(collected.result(WAIT)) == [0]
    assert pool.workers == ("good/1",), (
        "hosts that cannot do what the checker can are not asked again"
    )


def test_a_failure_is_made_good(learner: Learner, hire: Hire) -> None:
    learner.show()
    worker = hire("a/1")
    worker.want(1)
    collected = learner.collect(jobs(1))
    for _ in range(2):
        chunk = worker.chunk()
        worker.answer(worker.failure(chunk, 0, "once"))
    worker.work(1)
    assert done(collected.result(WAIT)) == [0]


def test_a_worker_that_cannot_serve_the_run_gets_no_more_jobs(
    learner: Learner, hire: Hire, caplog: pytest.LogCaptureFixture
) -> None:
    pool = learner.show()
    idle, worker = hire("a/1"), hire("b/1")
    collected = learner.collect(jobs(6))
    idle.want(3)
    chunk = idle.chunk()
    for _ in range(2):
        idle.answer(idle.failure(chunk, None, "not allowed here"))
    idle.want(3, idle=True)
    worker.want(2)
    worker.work(6)
    assert done(collected.result(WAIT)) == [0, 1, 2, 3, 4, 5]
    assert pool.workers == ("b/1",)
    assert [text for text in caplog.messages if "not allowed" in text] == [
        "worker a/1 does not serve this run: not allowed here"
    ]
