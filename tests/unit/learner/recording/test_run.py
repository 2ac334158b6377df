"""A run's recording, from its reports: learning neither waits for its thread nor fails with it."""

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made import report, stats

from farm.net.telemetry import Line, Report, RunEnd
from farm.sim.trajectory import Trajectory
from learner.recording.run import QUIET, RunRecording


class Slow:
    """A recorder that waits for a go."""

    uri = None

    def __init__(self, fails: Exception | None = None) -> None:
        self.go = threading.Event()
        self.settled = threading.Event()
        self.tended = threading.Event()
        self.generations: list[Report] = []
        self.lines: list[tuple[str, str]] = []
        self.replays: list[list[str]] = []
        self.results: list[Any] = []
        self.merged: bool | None = None
        self.fails = fails

    def generation(self, report: Report) -> None:
        self.go.wait()
        if self.fails:
            raise self.fails
        self.generations.append(report)

    def log(self, text: str, level: str) -> None:
        self.lines.append((level, text))

    def replay(self, path: Path, *, rollouts: list[tuple[str, Trajectory]]) -> None:
        assert path == Path("replay.rrd")
        self.replays.append([name for name, _ in rollouts])

    def result(self, values: Any) -> None:
        self.results.append(values)

    def final(self, rollout: Trajectory, generation: int) -> None:
        self.results.append(rollout)

    def settle(self) -> None:
        self.settled.set()

    def tend(self) -> None:
        self.tended.set()

    def close(self, *, merge: bool = True) -> None:
        self.merged = merge


def recording(recorder: Slow, **how: Any) -> RunRecording:
    return RunRecording(recorder, replay=Path("replay.rrd"), **how)  # type: ignore[arg-type]


def test_what_is_held_back_is_looked_at_when_nothing_comes() -> None:
    quiet = Slow()
    quiet.go.set()
    run = recording(quiet)
    run.put(report(stats()))
    assert quiet.tended.wait(10 * QUIET)
    assert run.taken()
    assert not quiet.settled.is_set()
    assert run.settled()
    assert quiet.settled.is_set()
    assert run.finish(timeout=10)
    assert quiet.merged is False, "the run may continue"


def test_a_run_from_its_reports(rollout: Callable[..., Trajectory]) -> None:
    quiet = Slow()
    quiet.go.set()
    run, sample = recording(quiet, done=3), rollout(2)
    run.put(report(stats(4), lines=(Line(level="WARNING", text="one worker left"),)))
    run.put(report(stats(5, return_max=2.0, best=2.0), replay=sample, replay_generation=5))
    assert (run.done, run.end) == (5, None)
    logging.getLogger("learner.made_up").warning("the disk is %s full", "nearly")
    lines = (Line(level="INFO", text="finished"),)
    end = RunEnd(
        summary={"state": "finished"}, lines=lines, best=sample, best_generation=5, mean=sample
    )
    run.put(end)
    assert run.finish(timeout=10)
    assert [each.generation for each in quiet.generations] == [4, 5]
    assert quiet.lines == [
        ("WARNING", "one worker left"),
        ("INFO", "new best rollout: return 2.000"),
        ("WARNING", "the disk is nearly full"),
        ("INFO", "finished"),
    ]
    best = "best rollout, generation 5"
    assert quiet.replays == [[best], [best, "mean policy after generation 5"]]
    assert quiet.results == [
        {"generations": 5, "return": sample.value, "success": sample.success},
        sample,
    ]
    assert (run.end, quiet.merged) == (end, True)


def test_a_run_that_diverged_has_no_mean_policy(rollout: Callable[..., Trajectory]) -> None:
    quiet = Slow()
    run = recording(quiet)
    run.put(
        RunEnd(
            summary={"state": "diverged"}, lines=(), best=rollout(2), best_generation=1, mean=None
        )
    )
    assert run.finish(timeout=10)
    assert (quiet.replays, quiet.results) == ([["best rollout, generation 1"]], [])
    assert quiet.merged


def test_a_slow_recorder_loses_rollouts_but_no_statistics(
    rollout: Callable[..., Trajectory],
) -> None:
    slow = Slow()
    run = recording(slow, waiting=4)
    for generation in range(1, 11):
        lines = (Line(level="INFO", text=str(generation)),)
        run.put(
            report(stats(generation), rollout(2), {"best": np.zeros((15, 12), "<f4")}, lines=lines)
        )
    slow.go.set()
    assert run.finish(timeout=10)
    numbers = list(range(1, 11))
    assert (
        [each.generation for each in slow.generations]
        == [int(text) for _, text in slow.lines]
        == numbers
    )
    whole = [each.sample is not None and bool(each.traces) for each in slow.generations]
    assert whole.count(False) == run.dropped
    assert run.dropped >= 7
    assert whole[0]


def test_a_broken_recorder_ends_with_one_line(caplog: pytest.LogCaptureFixture) -> None:
    broken = Slow(fails=OSError("no space left on device"))
    broken.go.set()
    run = recording(broken)
    with caplog.at_level(logging.INFO):
        for generation in range(1, 50):
            run.put(report(stats(generation)))
        assert not run.settled()
        assert not run.finish(timeout=10)
    assert run.failed
    assert [r.getMessage() for r in caplog.records] == [
        "the recording ends here, learning continues: no space left on device"
    ]
    assert broken.merged is False


def test_a_recorder_that_hangs_is_left_behind(caplog: pytest.LogCaptureFixture) -> None:
    slow = Slow()
    run = recording(slow)
    run.put(report(stats()))
    assert not run.finish(timeout=0.05)
    assert "not complete" in caplog.text
    slow.go.set()
