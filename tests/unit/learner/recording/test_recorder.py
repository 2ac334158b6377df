"""Recordings are written for real and read back with Rerun's own reader."""

import logging
import pickle
import socket
import subprocess
import sys
import textwrap
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from farm.arrays import AnyArray
from farm.errors import ConfigError
from farm.net.stats import GenerationStats
from farm.sim import scene as scenes
from farm.sim.scene import Geometry, Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait.hand import FINGERS, TIP_RADIUS
from learner.recording import recorder as recorders
from learner.recording.curves import ramp
from learner.recording.drawing import ARROW, ENDLESS, TOP_FORCE, Drawing, changes, rotate, solid
from learner.recording.recorder import Recorder, parts, record_replay
from learner.recording.thread import QUIET, RecorderThread

STEPS = 15
HORIZON = 1.5

Start = Callable[..., Recorder]
Batches = dict[str, list[Any]]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.load("bar")


@pytest.fixture
def start(tmp_path: Path, scene: Scene) -> Start:
    """Begin a recorder of a run called `try`."""

    def begin(done: int = 0) -> Recorder:
        path = tmp_path / "run.rrd"
        return Recorder(path, run="try", scene=scene, config="# settings", horizon=HORIZON, done=done)

    return begin


def progress(generation: int = 1) -> GenerationStats:
    numbers: dict[str, Any] = {
        "generation": generation,
        "rollouts": 30 * generation,
        "return_mean": -5.0 + 0.1 * generation,
        "return_min": -40.0,
        "return_max": -1.0,
        "return_std": 2.0,
        "best": -0.5,
        "baseline": -5.0,
        "mean_policy_return": -4.0,
        "mean_policy_success": False,
        "success_rate": 0.25,
        "sigma_mean": 2.0,
        "sigma_min": 1.0,
        "sigma_max": 3.0,
        "mean_norm": 8.0,
        "dropped": 2,
        "failed": 0,
        "clamped": 0,
        "reissued": 1,
        "workers": 3,
        "seconds": 1.0,
    }
    return GenerationStats(**numbers)


def rollout(scene: Scene, frames: int = STEPS + 1, step: float = 0.1) -> Trajectory:
    rng = np.random.default_rng(0)
    qpos = np.repeat(scene.model.qpos0[None], frames, axis=0)
    qpos[:, :8] = rng.uniform(0.0, 0.5, (frames, 8))
    images = rng.uniform(0.0, 1.0, (frames, 3, 18))
    images[: frames // 2, 1] = 0.0  # the middle finger touches later
    points = rng.normal(size=(frames, 3, 3))
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return Trajectory(
        times=np.arange(frames, dtype=np.float64) * step,
        bodies=scene.poses(qpos),
        joints=qpos[:, :8],
        targets=qpos[:, :8] + 0.1,
        images=images,
        points=np.where(images.any(axis=-1, keepdims=True), points, 0.0),
        terms=-rng.uniform(0.0, 1.0, (frames, 5)),
        value=-3.25,
        success=True,
    )


def traces(pairs: int = 2, seed: int = 0) -> dict[str, AnyArray]:
    values = np.random.default_rng(seed).uniform(0.0, 2.0, (2 * pairs, STEPS, 54))
    return {"best": values[0], "worst": values[1], "all": values.astype(np.float32)}


def read(path: Path) -> tuple[Batches, set[str]]:
    """Record batches by entity, and which entities are static."""
    batches: Batches = defaultdict(list)
    static: set[str] = set()
    for chunk in RrdReader(path).stream():
        batches[chunk.entity_path].append(chunk.to_record_batch())
        if chunk.is_static:
            static.add(chunk.entity_path)
    return batches, static


def count(batches: Batches, entity: str, component: str) -> int:
    """Rows of an entity that are on a timeline and have the component."""
    return len(column(batches, entity, component))


def column(batches: Batches, entity: str, name: str) -> list[Any]:
    """A column's values in the order of sim_time."""
    rows = []
    for batch in batches[entity]:
        found = [n for n in batch.schema.names if n == name or n.endswith(f":{name}")]
        if found and "sim_time" in batch.schema.names:
            times = batch.column("sim_time").cast("int64").to_pylist()
            rows += zip(times, batch.column(found[0]).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0]) if value is not None]


def times(batches: Batches, entity: str) -> list[int]:
    """An entity's sim_time [ns]."""
    timed = [b for b in batches[entity] if "sim_time" in b.schema.names]
    return sorted(t for b in timed for t in b.column("sim_time").cast("int64").to_pylist())


def test_generations_are_recorded_on_every_timeline(start: Start, tmp_path: Path, scene: Scene) -> None:
    recorder = start()
    recorder.log("it begins")
    for generation in (1, 2, 3):
        recorder.generation(progress(generation), rollout(scene), traces(), rate=120.0)
    recorder.close()
    batches, static = read(tmp_path / "run.rrd")
    assert count(batches, "/learning/return", "scalars") == 3
    assert column(batches, "/learning/return", "scalars")[2] == [
        -4.7,
        -40.0,
        -1.0,
        -0.5,
        -5.0,
        -4.0,
    ]
    assert column(batches, "/learning/return_std", "variances") == [[4.0]] * 3
    assert column(batches, "/farm/rollouts_per_s", "scalars") == [[120.0]] * 3
    frames = 3 * (STEPS + 1)
    for entity, component in {
        "/world/object": "translation",
        "/world/thumb_distal": "quaternion",
        "/world/index_distal/taxels": "colors",
        "/world/contacts": "vectors",
        "/tactile/middle": "buffer",
        "/contacts/force": "scalars",
        "/reward/terms": "scalars",
        "/joints/position": "scalars",
        "/joints/target": "scalars",
    }.items():
        assert count(batches, entity, component) == frames, entity
    for entity in ("/tactile/trace/best", "/tactile/trace/worst", "/tactile/traces"):
        assert len(times(batches, entity)) == 3
    assert {"/config", "/world/palm", "/world/palm/palm", "/world/object/bar"} <= static
    for entity, entries in batches.items():
        for batch in entries:
            lines = {"generation", "sim_time", "wall_time"} & set(batch.schema.names)
            assert len(lines) in (0, 3), entity
            assert not {"log_time", "log_tick"} & set(batch.schema.names), entity


def test_rollouts_follow_each_other_without_gap(start: Start, tmp_path: Path, scene: Scene) -> None:
    recorder = start()
    for generation in (4, 5):
        recorder.generation(progress(generation), rollout(scene), {}, rate=1.0)
    recorder.close()
    batches, _ = read(tmp_path / "run.rrd")
    at = np.array(times(batches, "/contacts/force")) / 1e9
    expected = np.concatenate([6.0 + np.arange(16) * 0.1, 7.5 + np.arange(16) * 0.1])
    np.testing.assert_allclose(at, expected, atol=2e-6)
    assert (np.diff(at) > 0).all(), "a last frame is hidden behind the next rollout's first"


def test_frames_hold_what_the_rollout_held(start: Start, tmp_path: Path, scene: Scene) -> None:
    shown = rollout(scene, frames=7)  # it ended early
    recorder = start()
    recorder.generation(progress(), shown, {}, rate=1.0)
    recorder.close()
    batches, _ = read(tmp_path / "run.rrd")
    np.testing.assert_array_equal(column(batches, "/reward/terms", "scalars"), shown.terms)
    np.testing.assert_array_equal(column(batches, "/joints/target", "scalars"), shown.targets)
    poses = shown.bodies[:, scene.bodies.index("index_distal")]
    found = np.array(column(batches, "/world/index_distal", "quaternion"))[:, 0]
    np.testing.assert_allclose(found, poses[:, [4, 5, 6, 3]], atol=1e-6)
    pixels = np.array(column(batches, "/tactile/thumb", "buffer"), dtype=np.uint8)[:, 0]
    images = np.ascontiguousarray(pixels).view(np.float32)
    np.testing.assert_array_equal(images, shown.images[:, 2].astype(np.float32))
    assert column(batches, "/contacts/state/middle", "state") == [["free"], ["contact"]]
    assert column(batches, "/contacts/state/index", "state") == [["contact"]]


def test_all_traces_come_back_bit_by_bit(start: Start, tmp_path: Path) -> None:
    recorder = start()
    kept = {g: traces(pairs=15, seed=g) for g in (1, 2)}
    for generation, values in kept.items():
        recorder.generation(progress(generation), None, values, rate=1.0)
    recorder.close()
    batches, _ = read(tmp_path / "run.rrd")
    for found, values in zip(column(batches, "/tactile/traces", "data"), kept.values(), strict=True):
        assert found[0]["shape"] == [30, STEPS, 54]
        array = np.array(found[0]["buffer"], dtype=np.float32).reshape(values["all"].shape)
        assert array.tobytes() == values["all"].tobytes()


def test_the_layout_travels_in_the_file(start: Start, tmp_path: Path) -> None:
    start().close()
    reader = RrdReader(tmp_path / "run.rrd")
    assert len(reader.blueprints()) == 1
    assert [r.recording_id for r in reader.recordings()] == ["try"]
    assert reader.recordings()[0].application_id == "rolloutfarm"


def test_a_run_that_goes_on_keeps_what_is_there(start: Start, tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "run.rrd"
    first = start()
    first.generation(progress(1), rollout(scene), traces(), rate=1.0)
    first.close()
    second = start(done=1)
    second.log("it goes on", "WARNING")
    second.generation(progress(2), rollout(scene), traces(), rate=1.0)
    assert parts(path) == [path, tmp_path / "run.part2.rrd"]
    second.close()
    assert parts(path) == [path]
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    assert [r.recording_id for r in RrdReader(path).recordings()] == ["try"]
    batches, _ = read(path)
    assert column(batches, "/learning/return", "generation") == [1, 2]
    assert count(batches, "/reward/terms", "scalars") == 2 * (STEPS + 1)
    assert column(batches, "/log", "generation") == [1]
    assert column(batches, "/log", "level") == [["WARN"]]


def test_parts_are_found_in_order(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    assert parts(path) == []
    names = ["run.rrd", "run.part2.rrd", "run.part10.rrd"]
    for name in [*reversed(names), "run.partner.rrd", "replay.rrd", "run.merging.rrd"]:
        (tmp_path / name).touch()
    assert [p.name for p in parts(path)] == names


def test_what_cannot_be_merged_stays(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run.rrd"
    start().close()
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    before = path.read_bytes()
    second = start(done=1)
    second.generation(progress(2), None, {}, rate=1.0)
    second.close()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir() if "part" in p.name] == ["run.part2.rrd"]
    assert "not merged" in caplog.text
    monkeypatch.undo()
    start(done=2).close()
    assert parts(path) == [path]
    assert column(read(path)[0], "/learning/return", "generation") == [2]


def test_rollouts_written_together_are_as_written_one_by_one(
    tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    lengths = (STEPS + 1, 3, STEPS + 1, 1)  # some ended early; one does not touch at all in the end
    shown = [rollout(scene, frames) for frames in lengths]
    rows = []
    for hold in (0.0, 1e9):
        monkeypatch.setattr(recorders, "HOLD", hold)
        monkeypatch.setattr(recorders.time, "time", iter(range(1_700_000_000, 1_800_000_000)).__next__)
        path = tmp_path / f"held-{hold:g}.rrd"
        recorder = Recorder(path, run="try", scene=scene, config="", horizon=HORIZON)
        for generation, sample in enumerate(shown, 1):
            recorder.generation(progress(generation), sample, {}, rate=1.0)
        recorder.close()
        batches, _ = read(path)
        names = {entity: {name for batch in batches[entity] for name in batch.schema.names} for entity in batches}
        rows.append(
            {
                (entity, name): column(batches, entity, name)
                for entity in batches
                for name in names[entity]
                if ":" in name or name == "generation"
            }
        )
    assert len(rows[0]) > 60
    assert rows[0] == rows[1]
    assert rows[0]["/contacts/state/index", "generation"] == [1, 2, 3, 4]
    assert rows[0]["/joints/position", "generation"] == [g for g, n in enumerate(lengths, 1) for _ in range(n)]


def test_what_is_held_back_is_written_when_nothing_comes() -> None:
    quiet = Slow()
    quiet.go.set()
    thread = RecorderThread(quiet)
    thread.generation(progress(), None, {}, 1.0)
    assert quiet.settled.wait(10 * QUIET)
    quiet.settled.clear()
    assert thread.settled()
    assert quiet.settled.is_set()
    assert thread.close(timeout=10)


def test_a_torn_file_is_mended(start: Start, tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "run.rrd"
    code = f"""
        import os, pickle, sys
        from pathlib import Path
        from farm.sim import scene as scenes
        from learner.recording.recorder import Recorder
        recorder = Recorder(Path({str(path)!r}), run="try", scene=scenes.load("bar"), config="",
                            horizon={HORIZON})
        for progress in pickle.load(sys.stdin.buffer):
            recorder.generation(progress, None, {{}}, 1.0)
        os._exit(9)
    """
    sent = pickle.dumps([progress(g) for g in range(1, 6)])
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], input=sent, check=False)
    assert ended.returncode == 9
    path.write_bytes(path.read_bytes()[:-37])
    recorder = start()
    recorder.generation(progress(6), rollout(scene), {}, rate=1.0)
    recorder.close()
    batches, _ = read(path)
    assert column(batches, "/learning/return", "generation") == [1, 2, 3, 4, 5, 6]


def test_wrong_input_is_refused(start: Start, scene: Scene) -> None:
    recorder = start()
    good = rollout(scene)
    with pytest.raises(ValueError, match="another scene"):
        recorder.generation(progress(), replace(good, bodies=good.bodies[:, 1:]), {}, rate=1.0)
    with pytest.raises(ValueError, match="frames"):
        recorder.generation(progress(), replace(good, terms=good.terms[1:]), {}, rate=1.0)
    with pytest.raises(ValueError, match="2D"):
        recorder.generation(progress(), None, {"best": np.zeros((2, 3, 4))}, rate=1.0)
    recorder.close()


def test_a_recording_needs_somewhere_to_go(scene: Scene) -> None:
    with pytest.raises(ConfigError, match="without a file"):
        Recorder(None, run="try", scene=scene, config="", horizon=HORIZON)


def test_viewers_are_served(scene: Scene) -> None:
    recorder = Recorder(None, run="try", scene=scene, config="", horizon=HORIZON, serve=("127.0.0.1", 0))
    assert recorder.uri is not None
    port = int(recorder.uri.removeprefix("rerun+http://127.0.0.1:").removesuffix("/proxy"))
    recorder.generation(progress(), rollout(scene), traces(), rate=1.0)
    socket.create_connection(("127.0.0.1", port), timeout=5).close()
    with pytest.raises(ConfigError, match="choose another"):
        Recorder(None, run="try", scene=scene, config="", horizon=HORIZON, serve=("127.0.0.1", port))
    recorder.close()


def test_replays_follow_each_other(tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "replay.rrd"
    shown = [
        ("best of generation 3", rollout(scene, 31, 0.01)),
        ("mean policy", rollout(scene, 16)),
    ]
    for _ in range(2):  # the second takes the first one's place
        record_replay(path, run="try", scene=scene, config="# settings", rollouts=shown)
    batches, _ = read(path)
    assert [p.name for p in tmp_path.iterdir()] == ["replay.rrd"]
    assert [r.recording_id for r in RrdReader(path).recordings()] == ["try-replay"]
    assert count(batches, "/world/object", "translation") == 31 + 16
    assert column(batches, "/reward/terms", "rollout") == [1] * 31 + [2] * 16
    captions = [text for (text,) in column(batches, "/rollout", "text")]
    assert "best of generation 3" in captions[0]
    assert "-3.25" in captions[1]
    assert (np.diff(times(batches, "/reward/terms")) > 0).all()


def test_arrows_push_the_fingers_at_their_contacts(scene: Scene) -> None:
    shown = rollout(scene)
    force = shown.images.sum(axis=-1)
    force[:, 0] = 1.0
    origins, vectors = Drawing(scene).contacts(shown.bodies, shown.points, force)
    data = mujoco.MjData(scene.model)
    for frame in range(len(force)):
        data.qpos[:8] = shown.joints[frame]
        mujoco.mj_kinematics(scene.model, data)
        for finger in range(3):
            site = data.site(f"{FINGERS[finger]}_tip")
            outward = site.xmat.reshape(3, 3) @ shown.points[frame, finger]
            expected = site.xpos + TIP_RADIUS * outward
            np.testing.assert_allclose(origins[frame, finger], expected, atol=1e-9)
            if finger == 0:
                np.testing.assert_allclose(vectors[frame, finger], -ARROW * outward, atol=1e-9)


def test_a_capsule_starts_where_its_axis_begins(scene: Scene) -> None:
    geometry = next(g for g in scene.geometries() if g.name == "thumb_distal")
    assert geometry.shape == "capsule"
    drawn = solid(geometry, [0, 0, 0, 255])
    start = np.array(drawn.translations.as_arrow_array().to_pylist()[0])
    length = drawn.lengths.as_arrow_array().to_pylist()[0]
    end = start + rotate(np.array(geometry.quaternion), np.array([0.0, 0.0, length]))
    ends = sorted([start, end], key=lambda point: point[2])
    np.testing.assert_allclose(ends, [[0.0, 0.0, 0.006], [0.0, 0.0, 0.034]], atol=1e-6)


@pytest.mark.parametrize(("size", "sides"), [((2.0, 3.0, 0.1), [2.0, 3.0]), ((0.0, 3.0, 0.1), [ENDLESS, 3.0])])
def test_a_plane_is_a_thin_box_with_its_top_where_the_plane_is(size: tuple[float, ...], sides: list[float]) -> None:
    half = np.sqrt(0.5)  # turned by 90 degrees about x: its normal is -y
    plane = Geometry("floor", "world", "plane", size, (1.0, 2.0, 3.0), (half, half, 0.0, 0.0), (0.5, 0.5, 0.5, 1.0))
    drawn = solid(plane, [0, 0, 0, 255])
    [extent], [centre] = (part.as_arrow_array().to_pylist() for part in (drawn.half_sizes, drawn.centers))
    np.testing.assert_allclose(extent, [*sides, 0.001], atol=1e-9)
    np.testing.assert_allclose(centre, [1.0, 2.001, 3.0], atol=1e-6)


def test_an_ellipsoid_has_three_radii() -> None:
    shape = Geometry(
        "e", "b", "ellipsoid", (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 1.0)
    )
    drawn = solid(shape, [0, 0, 0, 255])
    np.testing.assert_allclose(drawn.half_sizes.as_arrow_array().to_pylist(), [[0.1, 0.2, 0.3]], rtol=1e-6)


def test_another_tasks_rollout_is_refused(scene: Scene) -> None:
    good = rollout(scene)
    with pytest.raises(ValueError, match="another task"):
        list(Drawing(scene).columns(replace(good, images=good.images[:, :0])))


def test_colours_run_from_violet_to_yellow() -> None:
    colours = ramp(np.array([-1.0, 0.0, TOP_FORCE, 9.0]), TOP_FORCE)
    assert [hex(c) for c in colours] == ["0x440154ff"] * 2 + ["0xfde725ff"] * 2


def test_changes_are_the_first_row_and_every_other_state() -> None:
    assert changes(np.array([False, False, True, True, False])).tolist() == [0, 2, 4]
    assert changes(np.array([True])).tolist() == [0]


class Slow:
    """A recorder that waits for a go."""

    uri: str | None = "somewhere"

    def __init__(self, fails: Exception | None = None) -> None:
        self.go = threading.Event()
        self.generations: list[tuple[GenerationStats, Trajectory | None, Mapping[str, AnyArray], float]] = []
        self.lines: list[tuple[str, str]] = []
        self.settled = threading.Event()
        self.closed = False
        self.fails = fails

    def generation(
        self, progress: GenerationStats, sample: Trajectory | None, traces: Mapping[str, AnyArray], rate: float
    ) -> None:
        self.go.wait()
        if self.fails:
            raise self.fails
        self.generations.append((progress, sample, traces, rate))

    def log(self, text: str, level: str = "INFO") -> None:
        self.lines.append((text, level))

    def settle(self) -> None:
        self.settled.set()

    def close(self, *, merge: bool = True) -> None:  # noqa: ARG002
        self.closed = True


def test_a_slow_recorder_loses_rollouts_but_no_statistics(scene: Scene) -> None:
    slow = Slow()
    thread = RecorderThread(slow, waiting=4)
    shown = rollout(scene, frames=2)
    for generation in range(1, 11):
        thread.generation(progress(generation), shown, {"best": shown.images}, 1.0)
        thread.log(f"line {generation}", "WARNING")
    assert thread.uri == "somewhere"
    slow.go.set()
    assert thread.close(timeout=10)
    assert [p.generation for p, *_ in slow.generations] == list(range(1, 11))
    assert len(slow.lines) == 10
    whole = [sample is not None and bool(kept) for _, sample, kept, _ in slow.generations]
    assert whole.count(False) == thread.dropped
    assert thread.dropped >= 7
    assert whole[0]
    assert slow.closed


def test_a_broken_recorder_ends_with_one_line(caplog: pytest.LogCaptureFixture) -> None:
    broken = Slow(fails=OSError("no space left on device"))
    broken.go.set()
    thread = RecorderThread(broken)
    with caplog.at_level(logging.INFO):
        for generation in range(1, 50):
            thread.generation(progress(generation), None, {}, 1.0)
            thread.log("line")
        assert not thread.close(timeout=10)
    assert thread.failed
    assert [r.getMessage() for r in caplog.records] == [
        "the recording ends here, learning goes on: no space left on device"
    ]
    assert broken.closed


def test_a_recorder_that_hangs_is_left_behind(caplog: pytest.LogCaptureFixture) -> None:
    slow = Slow()
    thread = RecorderThread(slow)
    thread.generation(progress(), None, {}, 1.0)
    assert not thread.close(timeout=0.05)
    assert "not complete" in caplog.text
    slow.go.set()


def test_a_full_disk_is_noticed(tmp_path: Path) -> None:
    code = f"""
        import pickle, resource, sys
        from pathlib import Path
        from farm.sim import scene as scenes
        from learner.recording import recorder as recorders, rows
        rows.FLUSH = 1.0
        recorder = recorders.Recorder(Path({str(tmp_path / "run.rrd")!r}), run="try",
                            scene=scenes.load("bar"), config="", horizon={HORIZON})
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
        progress, traces = pickle.load(sys.stdin.buffer)
        try:
            for _ in range(100):
                recorder.generation(progress, None, traces, 1.0)
        except OSError:
            recorder.close()
            print("noticed")
    """
    sent = pickle.dumps((progress(), traces(pairs=15)))
    ended = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], input=sent, capture_output=True, check=False, timeout=60
    )
    assert b"noticed" in ended.stdout, ended.stderr.decode()


def test_a_recording_ends_before_the_disk_is_full(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = start()
    recorder.generation(progress(1), None, {}, rate=1.0)
    monkeypatch.setattr("learner.recording.recorder.RESERVE", 1 << 60)
    with pytest.raises(OSError, match="are needed"):
        recorder.generation(progress(2), None, {}, rate=1.0)
    recorder.close()
    batches, _ = read(tmp_path / "run.rrd")
    assert column(batches, "/learning/return", "generation") == [1]


def test_the_learner_does_without_rerun() -> None:
    code = "import sys, learner, learner.recording.thread, learner.recording.files as f; "
    code += "sys.exit('rerun' in sys.modules)"
    root = Path(__file__).parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_what_moves_is_looked_at():
    floor = '<geom type="plane" size="40 40 1"/>'
    ball = '<body name="ball" pos="1 2 3"><freejoint/><geom type="sphere" size="0.5" pos="0 0 1"/></body>'
    moving = Drawing(Scene(scenes.compiled(f"<mujoco><worldbody>{floor}{ball}</worldbody></mujoco>"))).mover()
    assert (moving.centre, moving.entity) == ((1.0, 2.0, 4.0), "/world/ball")
    assert moving.radius == pytest.approx(0.5 * 3**0.5), "half the diagonal of the box around it"
    assert Drawing(Scene(scenes.compiled(f"<mujoco><worldbody>{floor}</worldbody></mujoco>"))).mover() is None
