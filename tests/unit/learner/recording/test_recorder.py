"""Recordings are written and read back with Rerun's own reader."""

import dataclasses
import pickle
import re
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made import report, stats
from rerun.chunk import RrdReader

from farm.errors import ConfigError
from learner.recording import recorder as recorders
from learner.recording.comparison import Side, record_comparison
from learner.recording.drawing import Drawing
from learner.recording.files import parts
from learner.recording.recorder import Recorder
from learner.recording.replay import record_replay

WRITE = """
import os, pickle, resource, sys
from pathlib import Path
from farm.net.telemetry import Report
from farm.sim.model_files import compiled
from farm.sim.scene import Scene
from learner.recording import rows
from learner.recording.drawing import Drawing
from learner.recording.recorder import Recorder
path, mjcf, spec, calls, limit = pickle.load(sys.stdin.buffer)
drawing = Drawing(Scene(compiled(mjcf, "")), spec)
recorder = Recorder(Path(path), run="try", drawing=drawing, config="")
if limit:
    rows.FLUSH = 1.0
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    for stats, traces in calls:
        recorder.generation(Report(progress=stats, rate=1.0, traces=traces))
    recorder.settle()
except OSError:
    recorder.close()
    print("noticed")
os._exit(9)
"""
"""A recorder whose process is killed; its file may be limited."""


def killed(path, mjcf, spec, calls, limit=0):
    job = pickle.dumps((str(path), mjcf, spec, calls, limit))
    return subprocess.run(
        [sys.executable, "-uc", WRITE], input=job, capture_output=True, check=False, timeout=60
    )


def test_generations_are_recorded_on_every_timeline(start, rollout, traces, rows_of):
    recorder = start()
    recorder.log("it begins")
    for generation in (1, 2, 3):
        recorder.generation(report(stats(generation), rollout(), traces(), rate=120.0))
    recorder.close()
    rows = rows_of()
    assert rows.column("/learning/return", "scalars")[2] == [-4.7, -40.0, -1.0]
    assert rows.column("/learning/best", "scalars")[2] == [-0.5, -5.0]
    assert rows.column("/learning/return_std", "variances") == [[6.25]] * 3
    assert rows.column("/learning/lost", "scalars") == [[2.0, 0.0, 0.0]] * 3
    assert rows.column("/learning/success", "scalars") == [[0.25]] * 3
    assert rows.column("/learning/mean_policy/return", "scalars") == [[-4.0]] * 3
    assert rows.column("/learning/mean_policy/return", "generation") == [
        0,
        1,
        2,
    ], "updates behind each policy"
    assert rows.column("/learning/mean_policy/success", "scalars") == [[0.0]] * 3
    assert rows.column("/world/caption", "generation") == [0] * 16 + [1] * 16 + [2] * 16
    assert rows.column("/farm/rollouts_per_s", "scalars") == [[120.0]] * 3
    for entity in (
        "/world/ball",
        "/reward/terms",
        "/pads/left",
        "/world/touch/push",
        "/world/goals",
    ):
        assert len(rows.times(entity)) == 3 * 16, entity
    for entity, entries in rows.batches.items():
        for batch in entries:
            lines = {"generation", "sim_time", "wall_time"} & set(batch.schema.names)
            assert len(lines) in (0, 3), entity
            assert not {"log_time", "log_tick"} & set(batch.schema.names), entity


def test_rollouts_follow_each_other_without_gap(start, rollout, rows_of):
    recorder = start()
    for generation in (4, 5):
        recorder.generation(report(stats(generation), rollout()))
    recorder.close()
    rows = rows_of()
    at = np.array(rows.times("/touch/force")) / 1e9
    expected = np.concatenate([4.5 + np.arange(16) * 0.1, 6.0 + np.arange(16) * 0.1])
    np.testing.assert_allclose(at, expected, atol=2e-6)
    assert (np.diff(at) > 0).all(), "a last frame is hidden behind the next rollout's first"
    assert rows.times("/learning/return") == [6_000_000_000, 7_500_000_000]


def test_an_earlier_policy_of_a_finished_run_is_named_as_such(start, rollout, rows_of):
    recorder = start()
    for generation in (1, 2):
        recorder.generation(report(stats(generation, validation=3.0 - generation)))
    recorder.final(rollout(31, step=0.05), 1)
    recorder.close()
    rows = rows_of()
    assert rows.column("/learning/mean_policy/return", "scalars") == [[-4.0], [-4.0]]
    assert rows.column("/learning/mean_policy/validation", "scalars") == [[2.0], [1.0]]
    assert rows.column("/world/caption", "generation") == [2] * 31
    assert rows.column("/world/caption", "labels")[-1][0].startswith("generation 1\n")


def test_a_finished_run_opens_with_its_last_policy_playing(start, rollout, rows_of, tmp_path):
    recorder = start()
    for generation in (1, 2):
        recorder.generation(report(stats(generation), rollout()))
    recorder.final(rollout(31, step=0.05), 2)
    recorder.close()
    rows, reader = rows_of(), RrdReader(tmp_path / "run.rrd")
    assert rows.column("/learning/mean_policy/return", "scalars") == [[-4.0], [-4.0], [-3.25]]
    assert rows.column("/world/caption", "generation") == [0] * 16 + [1] * 16 + [2] * 31
    [*_, last] = rows.column("/world/caption", "labels")
    assert re.fullmatch(r"generation 2\nreturn -3\.250, success\nball moved \d+\.\d+ m", last[0])
    [layout] = reader.blueprints()
    panel = [chunk for chunk in reader.stream(store=layout) if chunk.entity_path == "/time_panel"]
    batches = [chunk.to_record_batch() for chunk in panel]
    names = [
        (batch, name)
        for batch in batches
        for name in batch.schema.names
        if name.startswith("TimePanel")
    ]
    values = {name: batch.column(name).to_pylist()[0] for batch, name in names}
    assert values["TimePanelBlueprint:timeline"] == ["generation"]


def test_traces_come_back_bit_by_bit(start, traces, rows_of):
    recorder = start()
    arrays = traces(30)
    recorder.generation(report(stats(), None, arrays))
    recorder.close()
    [[tensor]] = rows_of().column("/traces/all", "data")
    assert tensor["shape"] == [30, 15, 12]
    assert np.array(tensor["buffer"], dtype=np.float32).tobytes() == arrays["all"].tobytes()
    [[worst]] = rows_of().column("/traces/worst", "buffer")
    picture = np.array(worst, dtype=np.uint8).view(np.float32).reshape(12, 15)
    np.testing.assert_array_equal(picture, arrays["worst"].T)


def test_a_wrong_trace_is_refused(start):
    recorder = start()
    for name, shape in (("best", (14, 12)), ("worst", (15, 11)), ("all", (4, 15, 11))):
        with pytest.raises(ValueError, match=f"trace {name} of shape"):
            recorder.generation(report(stats(), None, {name: np.zeros(shape, "<f4")}))
    recorder.close()


def test_a_run_that_goes_on_keeps_what_is_there(start, rollout, tmp_path, rows_of):
    path = tmp_path / "run.rrd"
    first = start()
    first.generation(report(stats(1), rollout()))
    first.close()
    second = start(done=1)
    second.log("it goes on", "WARNING")
    second.generation(report(stats(2), rollout()))
    assert parts(path) == [path, tmp_path / "run.part2.rrd"]
    second.close()
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    assert [r.recording_id for r in RrdReader(path).recordings()] == ["try"]
    rows = rows_of()
    assert rows.column("/learning/return", "generation") == [1, 2]
    assert len(rows.times("/reward/terms")) == 2 * 16
    assert rows.column("/log", "generation") == [1]
    assert rows.column("/log", "level") == [["WARN"]]


def test_a_finished_run_that_goes_on_shows_one_rollout_at_a_time(start, rollout, rows_of):
    first = start()
    first.generation(report(stats(1), rollout()))
    first.final(rollout(31, step=0.05), 1)
    first.close()
    second = start(done=1, ended=True)
    for generation in (2, 3):
        second.generation(report(stats(generation), rollout()))
    second.close()
    rows = rows_of()
    assert rows.column("/world/caption", "generation") == [0] * 16 + [1] * 31 + [2] * 16
    assert (np.diff(rows.times("/touch/force")) > 0).all()


def test_parts_are_found_in_order(tmp_path):
    path = tmp_path / "run.rrd"
    assert parts(path) == []
    names = ["run.rrd", "run.part2.rrd", "run.part10.rrd"]
    for name in [*reversed(names), "run.partner.rrd", "replay.rrd", "run.merging.rrd"]:
        (tmp_path / name).touch()
    assert [p.name for p in parts(path)] == names


def test_what_cannot_be_merged_stays(start, tmp_path, rows_of, monkeypatch, caplog):
    path = tmp_path / "run.rrd"
    start().close()
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    before = path.read_bytes()
    second = start(done=1)
    second.generation(report(stats(2)))
    second.close()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if "part" in p.name] == ["run.part2.rrd"]
    assert "not merged" in caplog.text
    monkeypatch.undo()
    start(done=2).close()
    assert parts(path) == [path]
    assert rows_of().column("/learning/return", "generation") == [2]


def test_rollouts_written_together_are_as_written_one_by_one(start, rollout, rows_of, monkeypatch):
    lengths = (16, 3, 16, 1)  # some ended early
    samples = [rollout(frames) for frames in lengths]
    columns = []
    for hold in (0.0, 1e9):
        monkeypatch.setattr(recorders, "HOLD", hold)
        monkeypatch.setattr(recorders, "SHARE", 0.0)
        monkeypatch.setattr(
            recorders.time, "time", iter(range(1_700_000_000, 1_800_000_000)).__next__
        )
        recorder = start(f"held-{hold:g}.rrd")
        for generation, sample in enumerate(samples, 1):
            recorder.generation(report(stats(generation), sample))
        recorder.close()
        rows = rows_of(f"held-{hold:g}.rrd")
        names = {
            (e, n)
            for e, batches in rows.batches.items()
            for batch in batches
            for n in batch.schema.names
        }
        columns.append(
            {(e, n): rows.column(e, n) for e, n in names if ":" in n or n == "generation"}
        )
    assert len(columns[0]) > 60
    assert columns[0] == columns[1]
    assert columns[0]["/actions", "generation"] == [
        g for g, n in enumerate(lengths) for _ in range(n)
    ]
    assert set(columns[0]["/touch/state/left", "generation"]) == {
        0,
        1,
        2,
        3,
    }, "a rollout begins with its state"


def test_a_long_recording_is_written_in_few_groups(start, tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(recorders.time, "monotonic", lambda: now[0])
    recorder = start()
    for generation in range(1, 2001):
        now[0] += 1.0
        recorder.generation(report(stats(generation)))
    recorder.close(merge=False)
    groups = [
        chunk.to_record_batch()
        for chunk in RrdReader(tmp_path / "run.rrd").stream()
        if chunk.entity_path == "/learning/return" and not chunk.is_static
    ]
    assert sum(group.num_rows for group in groups) == 2000
    assert 50 < len(groups) < 500  # 100 (1 + ln 20) = 400


def test_much_is_written_at_once(start, rollout, monkeypatch):
    monkeypatch.setattr(recorders, "HOLD", 1e9)
    monkeypatch.setattr(recorders, "HELD", report(stats(1), rollout()).nbytes)
    recorder = start()
    written = []
    with monkeypatch.context() as patched:
        patched.setattr(recorder, "settle", lambda: written.append(recorder))
        recorder.generation(report(stats(1), rollout()))
    recorder.close()
    assert written == [recorder]


def test_a_torn_file_is_repaired(start, spec, scene_text, tmp_path, rows_of):
    path = tmp_path / "run.rrd"
    process = killed(path, scene_text, spec, [(stats(g), {}) for g in range(1, 6)])
    assert process.returncode == 9, process.stderr.decode()
    path.write_bytes(path.read_bytes()[:-37])
    recorder = start()
    recorder.generation(report(stats(6)))
    recorder.close()
    assert rows_of().column("/learning/return", "generation") == [1, 2, 3, 4, 5, 6]


@pytest.mark.slow
def test_a_full_disk_is_noticed(traces, spec, scene_text, tmp_path):
    process = killed(
        tmp_path / "run.rrd", scene_text, spec, [(stats(), traces(30))] * 100, limit=300_000
    )
    assert b"noticed" in process.stdout, process.stderr.decode()


def test_a_recording_ends_before_the_disk_is_full(start, rows_of, monkeypatch):
    recorder = start()
    recorder.generation(report(stats(1)))
    monkeypatch.setattr("learner.recording.recorder.RESERVE", 1 << 60)
    with pytest.raises(OSError, match="are needed"):
        recorder.generation(report(stats(2)))
    recorder.close()
    assert rows_of().column("/learning/return", "generation") == [1]


def test_viewers_are_served(scene, spec, rollout, traces):
    with pytest.raises(ConfigError, match="without a file"):
        Recorder(None, run="try", drawing=Drawing(scene, spec), config="")
    recorder = Recorder(
        None, run="try", drawing=Drawing(scene, spec), config="", serve=("127.0.0.1", 0)
    )
    assert recorder.uri is not None
    port = int(recorder.uri.removeprefix("rerun+http://127.0.0.1:").removesuffix("/proxy"))
    recorder.generation(report(stats(), rollout(), traces()))
    socket.create_connection(("127.0.0.1", port), timeout=5).close()
    with pytest.raises(ConfigError, match="choose another"):
        Recorder(
            None, run="try", drawing=Drawing(scene, spec), config="", serve=("127.0.0.1", port)
        )
    recorder.close()


def test_replays_follow_each_other(scene, spec, rollout, tmp_path, rows_of):
    path = tmp_path / "replay.rrd"
    rollouts = [("best of generation 3", rollout(31, 0.01)), ("mean policy", rollout())]
    for _ in range(2):  # the second takes the first one's place
        record_replay(
            path, run="try", drawing=Drawing(scene, spec), config="# settings", rollouts=rollouts
        )
    rows = rows_of("replay.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["replay.rrd"]
    assert [r.recording_id for r in RrdReader(path).recordings()] == ["try-replay"]
    assert rows.column("/reward/terms", "rollout") == [1] * 31 + [2] * 16
    captions = [text for (text,) in rows.column("/rollout", "text")]
    assert "best of generation 3" in captions[0]
    assert "-3.250, success" in captions[1]
    assert (np.diff(rows.times("/reward/terms")) > 0).all()


CURVES = ("/reward/terms", "/actions", "/touch/force", "/touch/force/limits")


def test_no_curve_goes_from_one_rollout_of_a_replay_to_the_next(
    scene, spec, rollout, tmp_path, rows_of
):
    rollouts = [("one", rollout(31, 0.01)), ("other", rollout()), ("third", rollout())]
    record_replay(
        tmp_path / "r.rrd", run="try", drawing=Drawing(scene, spec), config="", rollouts=rollouts
    )
    for entity in CURVES:
        np.testing.assert_allclose(rows_of("r.rrd").breaks(entity), [0.35e9, 1.95e9])


def test_no_curve_goes_from_a_rollout_that_ended_early_to_the_next_generations(
    start, rollout, rows_of
):
    recorder = start()
    for generation, frames in ((1, 16), (2, 4), (3, 16)):
        recorder.generation(report(stats(generation), rollout(frames)))
    recorder.close()
    for entity in CURVES:
        np.testing.assert_allclose(rows_of().breaks(entity), [1.5e9 + 0.3e9 + 1e3])


def test_the_eye_follows_a_body_that_moves_away(scene, spec, rollout, tmp_path, rows_of):
    sample, mover = rollout(), scene.mover
    bodies = np.tile(scene.poses(scene.model.qpos0[None]), (16, 1, 1))
    bodies[8:, [at for at, name in enumerate(scene.bodies) if name not in scene.fixed], 0] += 10.0
    away = dataclasses.replace(sample, bodies=bodies.astype("<f4"))
    record_replay(
        tmp_path / "r.rrd",
        run="try",
        drawing=Drawing(scene, spec),
        config="",
        rollouts=[("gone", away)],
    )
    places = np.array(rows_of("r.rrd").column("/world/view", "positions"))[:, 0]
    np.testing.assert_allclose(places[:8], np.tile(mover.centre, (8, 1)), atol=1e-6)
    np.testing.assert_allclose(
        places[8:, 0], mover.centre[0] + 10.0 - 0.4 * mover.radius, atol=1e-5
    )


def test_runs_are_compared_by_the_scalars_that_all_have(
    scene, spec, plain, rollout, tmp_path, rows_of
):
    curves = [stats(g) for g in (1, 2)]
    both = [Side(name, Drawing(scene, spec), curves, rollout()) for name in ("one", "other")]
    record_comparison(tmp_path / "compare.rrd", both, "| table |")
    rows = rows_of("compare.rrd")
    force = rollout().channels["touch/force"]
    for root in ("/runs/one", "/runs/other"):
        np.testing.assert_array_equal(
            np.array(rows.column(f"{root}/touch/force/left", "scalars"))[:, 0], force[:, 0]
        )
        assert len(rows.times(f"{root}/world/ball")) == 16
    [where] = rows.fixed("/runs/other", "translation")
    assert np.linalg.norm(where) > scene.mover.radius, "scenes stand apart"
    record_comparison(
        tmp_path / "mixed.rrd",
        [both[0], Side("c", Drawing(scene, plain), curves, rollout(spec=plain))],
        "",
    )
    assert not [entity for entity in rows_of("mixed.rrd").batches if "force" in entity]


def test_parts_are_known_without_rerun():
    code = "import sys, learner, learner.recording.files; sys.exit('rerun' in sys.modules)"
    root = Path(__file__).parents[4]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0
