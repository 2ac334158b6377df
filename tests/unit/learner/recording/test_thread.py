"""The recorder's thread: learning neither waits for it nor fails with it."""

import logging
import threading

import numpy as np
import pytest

from learner.recording.run import QUIET, RecorderThread


class Slow:
    """A recorder that waits for a go."""

    def __init__(self, fails=None):
        self.go = threading.Event()
        self.settled = threading.Event()
        self.generations, self.lines, self.closed, self.fails = [], [], False, fails

    def generation(self, stats, sample, traces, rate):
        self.go.wait()
        if self.fails:
            raise self.fails
        self.generations.append((stats, sample, traces, rate))

    def settle(self):
        self.settled.set()

    def close(self, *, merge=True):
        self.closed = True


def test_what_is_held_back_is_written_when_nothing_comes(stats):
    quiet = Slow()
    quiet.go.set()
    thread = RecorderThread(quiet)
    thread.generation(stats(), None, {}, 1.0)
    assert quiet.settled.wait(10 * QUIET)
    quiet.settled.clear()
    assert thread.settled()
    assert quiet.settled.is_set()
    assert thread.close(timeout=10)


def test_a_slow_recorder_loses_rollouts_but_no_statistics(stats, rollout):
    slow = Slow()
    thread = RecorderThread(slow, waiting=4)
    for generation in range(1, 11):
        thread.generation(stats(generation), rollout(2), {"best": np.zeros((15, 12))}, 1.0)
        thread.put(lambda line=generation: slow.lines.append(line))
    slow.go.set()
    assert thread.close(timeout=10)
    assert [s.generation for s, *_ in slow.generations] == slow.lines == list(range(1, 11))
    whole = [sample is not None and bool(kept) for _, sample, kept, _ in slow.generations]
    assert whole.count(False) == thread.dropped
    assert thread.dropped >= 7
    assert whole[0]
    assert slow.closed


def test_a_broken_recorder_ends_with_one_line(stats, caplog: pytest.LogCaptureFixture):
    broken = Slow(fails=OSError("no space left on device"))
    broken.go.set()
    thread = RecorderThread(broken)
    with caplog.at_level(logging.INFO):
        for generation in range(1, 50):
            thread.generation(stats(generation), None, {}, 1.0)
        assert not thread.close(timeout=10)
    assert thread.failed
    assert [r.getMessage() for r in caplog.records] == [
        "the recording ends here, learning continues: no space left on device"
    ]
    assert broken.closed


def test_a_recorder_that_hangs_is_left_behind(stats, caplog: pytest.LogCaptureFixture):
    slow = Slow()
    thread = RecorderThread(slow)
    thread.generation(stats(), None, {}, 1.0)
    assert not thread.close(timeout=0.05)
    assert "not complete" in caplog.text
    slow.go.set()
