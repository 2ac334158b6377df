"""A fingertip is pressed at known points in the simulator; image, scene and picture must show
them.
"""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from farm.arrays import FloatArray
from farm.sim.engines import DataEngine
from farm.sim.scene import Scene
from farm.sim.sim import Sim
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.hand import FINGERS, LOWER, TIP_RADIUS, UPPER
from farm.tasks.finger_gait.task import FingerGait
from learner.recording.drawing import Drawing
from learner.recording.replay import record_replay

BALL, DEPTH = 0.004, 0.0005
"""Radius of what presses, and how far into the fingertip it begins [m]."""

PITCH, ACROSS = np.deg2rad([-45.0, -15.0, 15.0, 45.0, 75.0, 105.0]), np.deg2rad([-45.0, 0.0, 45.0])
"""Where it presses: angles from the finger's axis towards its pad, and across, as docs/task.md has
rows and columns.
"""

PLACES = [(finger, row, column) for finger in range(3) for row in range(6) for column in range(3)]


@pytest.fixture(scope="module")
def task() -> FingerGait:
    """The gait with a small ball as its object."""
    box, ball = r'(<geom name="bar" )type="box" size="[^"]*"', rf'\1type="sphere" size="{BALL}"'
    files = model.files(["bar"], "opposed")
    return FingerGait(files={**files, "object.xml": re.sub(box, ball, files["object.xml"])})


@pytest.fixture(scope="module")
def pressed(task: FingerGait) -> Trajectory:
    """A frame for each of PLACES, in different poses of the hand."""
    rng, frames = np.random.default_rng(0), []
    for finger, row, column in PLACES:
        joints = LOWER + rng.uniform(0.1, 0.5, 8) * (UPPER - LOWER)
        frames.append(press(task, joints, finger, towards(PITCH[row], ACROSS[column])))
    arrays = {name: np.concatenate([frame[name] for frame in frames]) for name in frames[0]}
    count, scene = len(frames), Scene(task.model)
    return Trajectory.of(
        times=0.1 * np.arange(count),
        bodies=scene.poses(arrays["qpos"]),
        actions=np.zeros((count, 8)),
        terms=np.zeros((count, 5)),
        channels=task.show(arrays),
        value=0.0,
        success=False,
    )


def towards(pitch: float, across: float) -> FloatArray:
    """In the fingertip's frame: z along the finger, x to its pad."""
    return np.array(
        [np.cos(across) * np.sin(pitch), np.sin(across), np.cos(across) * np.cos(pitch)]
    )


def press(
    task: FingerGait, joints: FloatArray, finger: int, way: FloatArray
) -> dict[str, FloatArray]:
    """Put the ball, held as before a release, onto a fingertip from there: what is measured, (1,
    ...) each.
    """
    engine = DataEngine(task.model)
    sim, data = Sim(engine), engine.data
    sim.begin(1)
    data.qpos[:8] = data.ctrl[:] = joints
    mujoco.mj_kinematics(task.model, data)
    tip = data.site(f"{FINGERS[finger]}_tip")
    data.qpos[8:11] = tip.xpos + tip.xmat.reshape(3, 3) @ way * (TIP_RADIUS + BALL - DEPTH)
    data.mocap_pos[0] = data.qpos[8:11]
    sim.forward()
    frame = {
        "qpos": data.qpos[None].copy(),
        **{k: np.array(v) for k, v in task.measure(sim).items()},
    }
    force = task.show(frame)["contacts/force"][0, finger]
    assert force == pytest.approx(normal_force(task.hand, data, finger), rel=1e-9)
    return frame


def normal_force(scene: model.Hand, data: mujoco.MjData, finger: int) -> float:
    """Between the ball and a fingertip, from MuJoCo's own list of contacts [N]."""
    total, force = 0.0, np.zeros(6)
    for i, contact in enumerate(data.contact):
        if set(contact.geom.tolist()) == {scene.object_geoms[0], scene.tip_geoms[finger]}:
            mujoco.mj_contactForce(scene.model, data, i, force)
            total += force[0]
    return total


def test_the_taxel_under_the_ball_feels_most(pressed: Trajectory) -> None:
    for image, (finger, row, column) in zip(pressed.channels["tactile"], PLACES, strict=True):
        grid = image[finger]
        assert grid.sum() > 0
        assert np.unravel_index(grid.argmax(), grid.shape) == (row, column)
        assert not np.delete(image, finger, axis=0).any()


def test_the_last_rows_lie_where_a_bending_finger_closes(
    task: FingerGait, pressed: Trajectory
) -> None:
    data = mujoco.MjData(task.model)
    last = {0: 2, 1: 5, 2: 7}  # a finger's last joint
    for joints, (finger, row, _) in zip(pressed.channels["joints/position"], PLACES, strict=True):
        ends = []
        for bend in (0.0, 1e-4):
            data.qpos[:8] = joints
            data.qpos[last[finger]] += bend
            mujoco.mj_kinematics(task.model, data)
            ends.append(data.site(f"{FINGERS[finger]}_tip").xpos.copy())
        closing = data.site(f"{FINGERS[finger]}_tip").xmat.reshape(3, 3).T @ (ends[1] - ends[0])
        side = towards(PITCH[row], 0.0) @ closing
        assert (side > 0) == (row >= 2)  # the first two rows are on the back


def test_the_picture_is_brightest_where_the_ball_presses(
    task: FingerGait, pressed: Trajectory, tmp_path: Path
) -> None:
    path = tmp_path / "pressed.rrd"
    scene, spec = Scene(task.model), task.spec()
    record_replay(
        path,
        run="pressed",
        drawing=Drawing(scene, spec),
        config="# a ball",
        rollouts=[("pressed", pressed)],
    )
    formats, buffers, colours = {}, {}, {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if chunk.entity_path.startswith("/tactile/") and name.endswith("DepthImage:format"):
                formats[chunk.entity_path] = batch.column(name).to_pylist()[0][0]
            if chunk.entity_path.startswith("/tactile/") and name.endswith("DepthImage:buffer"):
                buffers[chunk.entity_path] = batch.column(name).to_pylist()
            if (
                chunk.entity_path.endswith("_distal/tactile")
                and name.endswith("Points3D:colors")
                and not chunk.is_static
            ):
                colours[chunk.entity_path] = batch.column(name).to_pylist()
    for frame, (finger, row, column) in enumerate(PLACES):
        entity = f"/tactile/{FINGERS[finger]}"
        height, width = formats[entity]["height"], formats[entity]["width"]
        assert (height, width) == (6, 3)  # rows from the top, a row's pixels from the left
        pixels = (
            np.array(buffers[entity][frame][0], np.uint8).view(np.float32).reshape(height, width)
        )
        assert np.unravel_index(pixels.argmax(), pixels.shape) == (row, column)
        np.testing.assert_array_equal(
            pixels.ravel(), pressed.channels["tactile"][frame, finger].ravel().astype(np.float32)
        )
        # Rises with the force
        green = np.array(colours[f"/world/{FINGERS[finger]}_distal/tactile"][frame]) >> 16 & 255
        assert green[3 * row + column] == green.max()
