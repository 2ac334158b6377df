"""Nothing is left of recordings that are closed: neither threads nor open files."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from full import files_of_at_most
from made import report, stats

from learner.recording import rows
from learner.recording.comparison import Side, record_comparison
from learner.recording.drawing import Drawing
from learner.recording.recorder import Recorder
from learner.recording.replay import record_replay
from learner.recording.run import RunRecording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="counts threads in /proc"),
]
COUNT = 20


def left() -> tuple[int, int]:
    """Threads and open files of this process."""
    threads, files = ([*Path(f"/proc/self/{name}").iterdir()] for name in ("task", "fd"))
    return len(threads), len(files)


def settled(most: tuple[int, int]) -> tuple[int, int]:
    """What is left, as soon as it is not more than `most`, or after some seconds: a thread's end
    takes a moment.
    """
    until = time.monotonic() + 10.0
    while (
        any(now > before for now, before in zip(left(), most, strict=True))
        and time.monotonic() < until
    ):
        time.sleep(0.01)
    return left()


def unchanged(record: Callable[[int], None], count: int = COUNT) -> None:
    """Record once, for what Rerun starts only once, and then `count` times, which must leave
    nothing.
    """
    record(0)
    before = left()
    for number in range(1, count + 1):
        record(number)
    now = settled(before)
    assert now[0] <= before[0] + 1, f"threads: {before[0]}, after {count} more recordings {now[0]}"
    assert now[1] <= before[1] + 1, (
        f"open files: {before[1]}, after {count} more recordings {now[1]}"
    )


def test_of_replays(tmp_path, scene, spec, rollout, monkeypatch):
    # A process of its own, half a second
    monkeypatch.setattr("learner.recording.replay.compact", lambda _: True)
    drawing, one = Drawing(scene, spec), rollout()

    def record(_: int) -> None:
        record_replay(
            tmp_path / "replay.rrd", run="try", drawing=drawing, config="", rollouts=[("best", one)]
        )

    unchanged(record)


def test_of_comparisons(tmp_path, scene, spec, rollout):
    sides = [
        Side(name, Drawing(scene, spec), [stats(1), stats(2)], rollout()) for name in ("a", "b")
    ]
    unchanged(lambda _: record_comparison(tmp_path / "compare.rrd", sides, "| a | b |"))


def test_of_runs(tmp_path, scene, spec, rollout, traces):
    def record(number: int) -> None:
        recorder = Recorder(
            tmp_path / f"{number}.rrd", run="try", drawing=Drawing(scene, spec), config=""
        )
        recording = RunRecording(recorder)
        recording.put(report(stats(1), rollout(), traces()))
        assert recording.finish()

    unchanged(record)


def test_of_finished_runs_with_their_layouts(tmp_path, scene, spec, rollout):
    def record(number: int) -> None:
        recorder = Recorder(
            tmp_path / f"{number}.rrd", run="try", drawing=Drawing(scene, spec), config=""
        )
        recorder.generation(report(stats(1), rollout()))
        recorder.final(rollout(), 1)
        recorder.close()

    unchanged(record, count=3)


def test_of_live_streams(scene, spec, rollout):
    def record(_: int) -> None:
        drawing = Drawing(scene, spec)
        recorder = Recorder(None, run="try", drawing=drawing, config="", serve=("127.0.0.1", 0))
        recorder.generation(report(stats(1), rollout()))
        recorder.close()

    unchanged(record, count=10)


def test_of_recordings_that_fail_half_way(tmp_path, scene, spec, rollout, monkeypatch):
    sides = [Side("a", Drawing(scene, spec), [stats(1)], rollout())]

    def fails(*_: object) -> None:
        raise ValueError("half way")

    monkeypatch.setattr("learner.recording.comparison._send_rollout", fails)

    def record(_: int) -> None:
        with pytest.raises(ValueError, match="half way"):
            record_comparison(tmp_path / "compare.rrd", sides, "")

    unchanged(record)


def test_a_recording_that_cannot_be_written_does_not_stop_later_ones(
    tmp_path, scene, spec, rollout, monkeypatch
):
    monkeypatch.setattr(rows, "FLUSH", 0.5)
    sides = [Side("a", Drawing(scene, spec), [stats(1)], rollout(frames=2000))]
    with files_of_at_most(10_000), pytest.raises(OSError, match="Rerun has stopped writing"):
        record_comparison(tmp_path / "full.rrd", sides, "")
    assert not list(tmp_path.iterdir())
    record_comparison(tmp_path / "compare.rrd", sides, "")
    assert (tmp_path / "compare.rrd").stat().st_size > 10_000
