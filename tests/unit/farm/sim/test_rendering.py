"""Pictures of any model, drawn in a separate process, because MuJoCo chooses its renderer when it
is imported.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

from farm.sim.channels import Camera
from farm.sim.framing import AWAY, View, beside
from farm.sim.model_files import compiled
from farm.sim.rendering import lit
from farm.sim.scene import Scene

MJCF = """
<mujoco>
  <worldbody>
    <body name="ball"><freejoint/><geom name="ball" size="0.5" rgba="0 0 0 1"/></body>
  </worldbody>
</mujoco>
"""
DRAW = f"""
import sys
import numpy as np
from farm.errors import RunError
from farm.sim.rendering import pictures
from farm.sim.model_files import compiled
from farm.tasks.base import Channel
model = compiled({MJCF!r}, "ball")
blue = (0, 0, 255)
touch = Channel(name="touch", kind="scalars", shape=(1,), geoms=("ball",), colours=(blue,), top=2.0)
qpos = np.repeat(model.qpos0[None], 3, axis=0)
values = {{"touch": np.array([[0.0], [0.001], [2.0]])}}
try:
    drawn = list(pictures(model, qpos, (40, 30), camera=None, channels=[touch], values=values))
except RunError as error:
    sys.exit(str(error))
assert (model.geom_rgba == [[0, 0, 0, 1]]).all(), "the physics' model is changed"
np.save("drawn.npy", np.array(drawn))
"""


def drawn_by(code, tmp_path):
    """Pictures (F, height, width, 3) that a program draws in a process of its own."""
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    words = [sys.executable, "-c", code]
    done = subprocess.run(
        words,
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    if "cannot draw here" in done.stderr:
        pytest.skip("no OSMesa and no EGL")
    assert done.returncode == 0, done.stderr
    return np.load(tmp_path / "drawn.npy").astype(int)


def test_geometries_are_painted_by_a_channels_values(tmp_path):
    pictures = drawn_by(DRAW, tmp_path)
    assert pictures.shape == (3, 30, 40, 3)
    np.testing.assert_allclose(pictures[:, 0, 0], np.tile([240, 242, 245], (3, 1)), atol=2)
    untouched, lightest, full = pictures[:, 15, 20]
    assert np.ptp(untouched) < 10, "white"
    assert lightest[2] - lightest[0] > 50, "the lightest touch shows"
    assert full[2] > 150
    assert full[0] < 100


FLOOR = """
import sys
import numpy as np
from farm.errors import RunError
from farm.sim.rendering import pictures
from farm.sim.model_files import compiled
from farm.tasks.base import Camera
camera = Camera(lookat=(0, 0, 0), distance=4.0, azimuth=90.0, elevation=-90.0)
drawn = []
for colour in ("", 'rgba="0.2 0.3 0.2 1"'):
    mjcf = f'''<mujoco><worldbody><geom type="plane" size="0 0 1" {colour}/>
      <body pos="0 0 0.2"><freejoint/><geom size="0.2"/></body></worldbody></mujoco>'''
    model = compiled(mjcf, "floor")
    try:
        drawn += list(pictures(model, model.qpos0[None], (240, 240), camera=camera))
    except RunError as error:
        sys.exit(str(error))
np.save("drawn.npy", np.array(drawn))
"""


def test_a_bare_floor_is_light_with_lines_and_a_painted_one_stays(tmp_path):
    bare, painted = drawn_by(FLOOR, tmp_path)
    corner = bare[10:110, 10:110].mean(axis=-1)
    assert np.median(corner) > 220
    lines = corner < np.median(corner) - 30
    assert 0.005 < lines.mean() < 0.2
    assert lines.mean(axis=0).max() > 0.9, "lines from top to bottom"
    assert lines.mean(axis=1).max() > 0.9, "and from left to right"
    ball = bare[120, 120]
    assert ball[2] > ball[0] + 60, "the first body is blue"
    assert painted[10:110, 10:110].mean(axis=-1).max() < 120


def test_the_light_leaves_the_model_alone():
    model = compiled(MJCF, "ball")
    before = model.vis.headlight.ambient.copy(), model.vis.global_.offwidth
    bright = lit(model, 2.0, (2000, 100))
    assert bright.vis.global_.offwidth == 4000
    assert bright.vis.headlight.ambient[0] != before[0][0]
    assert (model.vis.headlight.ambient.tolist(), model.vis.global_.offwidth) == (
        before[0].tolist(),
        before[1],
    )
    np.testing.assert_array_equal(bright.body_mass, model.body_mass)


def test_a_scene_without_a_camera_is_seen_from_beside_what_moves():
    camera = beside(Scene(compiled(MJCF, "ball")))
    assert camera.lookat == (0.0, 0.0, 0.0)
    assert camera.distance == pytest.approx(AWAY * 0.5 * 3**0.5)


def test_a_picture_frames_the_first_state_and_follows_what_moves_away(tmp_path):
    places = "[[9, 9, 9], [9, 9.1, 9], [2, 9, 9]]"
    away = f"qpos, values = np.repeat(model.qpos0[None], 3, axis=0), None; qpos[:, :3] = {places}"
    code = DRAW.replace(next(line for line in DRAW.splitlines() if line.startswith("qpos")), away)
    pictures = drawn_by(code.replace("[touch]", "[]"), tmp_path)
    assert (pictures[:, 15, 20].max(axis=-1) < 120).all(), "the black ball is in the middle of each"
    assert (pictures[0] != pictures[1]).any(), "a ball that hardly moves does not move the camera"


def test_the_view_follows_a_body_that_leaves_the_middle_but_no_swinging():
    scene = Scene(compiled(MJCF, "ball"), np.array([5.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    view, slack = View(scene, None), 0.4 * scene.mover.radius
    assert view.camera.lookat == (5.0, 0.0, 1.0), "where it starts, not where the model puts it"
    assert (view.mover.place, view.mover.index) == ((5.0, 0.0, 1.0), 1)
    for x, expected in ((5.0 + 0.9 * slack, 0.0), (15.0, 10.0 - slack), (15.0, 0.0)):
        np.testing.assert_allclose(view.moved(np.array([x, 0.0, 1.0])), [expected, 0.0, 0.0])
    np.testing.assert_allclose(view.back(), [slack - 10.0, 0.0, 0.0])
    np.testing.assert_array_equal(view.moved(np.array([5.0, 0.0, 1.0])), np.zeros(3))
    assert (
        View(scene, Camera(lookat=(0.0, 0.0, 0.0), distance=1.0, azimuth=0.0, elevation=0.0)).mover
        is None
    )


MARKS = """
import sys
import numpy as np
from farm.errors import RunError
from farm.sim.rendering import pictures
from farm.sim.model_files import compiled
from farm.tasks.base import Camera, Channel
mjcf = '''<mujoco><worldbody><body name="goal" mocap="true" pos="0 0 -0.6">
    <geom size="0.1" rgba="0 0 0 1"/></body>
  <body name="box"><joint type="slide" axis="1 0 0"/>
  <geom type="box" size="0.1 0.1 0.1" rgba="1 1 1 1"/></body>
  </worldbody></mujoco>'''
model = compiled(mjcf, "box")
camera = Camera(lookat=(0, 0, 0), distance=3.0, azimuth=90.0, elevation=0.0)  # x to the right, z up
red, blue = (255, 0, 0), (0, 0, 255)
channels = [
    Channel(
        name="push", kind="arrows", shape=(1, 6), bodies=("box",), length=0.5, longest=0.6,
        colours=(red,),
    ),
    Channel(name="place", kind="points", shape=(1, 4), colours=(blue,), top=2.0),
    Channel(name="touch", kind="images", shape=(1, 1, 2), bodies=("box",), colours=(blue,),
            places=np.array([[[-0.5, -0.2, 0.3], [-0.5, -0.2, -0.3]]])),
]
qpos = np.array([[0.0], [0.0], [0.3]])
values = {
    "push": np.array([[[0, -0.2, 0, 0, 0, push]] for push in (0.0, 9.0, 1.0)]),
    "place": np.array([[[-0.6, 0, -0.6, 2.0]]] * 3),
    "touch": np.array([[[[0.0, 0.0]]], [[[1.0, 0.0]]], [[[0.0, 1.0]]]]),
}
mocap = np.tile([0.0, 0.0, -0.6, 1, 0, 0, 0], (3, 1, 1))
mocap[2, 0, 0] = 0.6
try:
    drawn = pictures(
        model, qpos, (480, 480), camera=camera, mocap=mocap, channels=channels, values=values
    )
    np.save("drawn.npy", np.array(list(drawn)))
except RunError as error:
    sys.exit(str(error))
"""


def test_arrows_points_and_touched_places_are_drawn_where_they_are_and_goals_move(tmp_path):
    pictures = drawn_by(MARKS, tmp_path)

    def pixel(frame, x, z, near=0.0):
        # Pixels per metre, so much nearer than the target
        scale = 240 / ((3.0 - near) * np.tan(np.deg2rad(22.5)))
        return pictures[frame, round(239.5 - z * scale), round(239.5 + x * scale)]

    def is_red(colour):
        return colour[0] > colour[2] + 60

    def is_blue(colour):
        return colour[2] > colour[0] + 60

    assert not is_red(pixel(0, 0.0, 0.3, 0.2)), "an arrow of length 0 is not drawn"
    assert is_red(pixel(1, 0.0, 0.5, 0.2)), "its whole length"
    assert not is_red(pixel(1, 0.0, 0.65, 0.2)), "it is cut at `longest`"
    assert is_red(pixel(2, 0.3, 0.3, 0.2)), "it goes with its body"
    assert not is_red(pixel(2, 0.0, 0.3, 0.2))
    for frame in range(3):
        assert is_blue(pixel(frame, -0.6, -0.6)), "a point in the world stays"
    where = ((-0.5, 0.3), (-0.5, -0.3), (-0.2, -0.3))
    spots = [[bool(is_blue(pixel(frame, x, z, 0.2))) for x, z in where] for frame in range(3)]
    assert spots == [
        [False, False, False],
        [True, False, False],
        [False, False, True],
    ], "only what feels something"
    assert pixel(0, 0.0, -0.6).max() < 80, "the goal"
    assert pixel(2, 0.6, -0.6).max() < 80
    assert pixel(2, 0.0, -0.6).max() > 150


def test_a_goal_is_framed_but_the_robot_is_followed():
    mjcf = MJCF.replace(
        "<worldbody>", '<worldbody><body name="goal" mocap="true"><geom size="0.1"/></body>'
    )
    mocap = np.array([[8.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    scene = Scene(compiled(mjcf, "ball"), np.array([5.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), mocap)
    assert scene.mover.body == "ball"
    assert scene.mover.place == (5.0, 0.0, 0.0)
    np.testing.assert_allclose(scene.mover.centre, [(4.5 + 8.1) / 2, 0.0, 0.0])
    only = Scene(compiled(mjcf.replace("<freejoint/>", ""), "goal"), None, mocap)
    assert only.mover.body == "goal"
