"""Pictures of any model, drawn in a separate process, because MuJoCo chooses its renderer when it is imported."""

import os
import subprocess
import sys

import numpy as np
import pytest

from farm.sim.rendering import beside, lit
from farm.sim.scene import AWAY, Scene, compiled

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
from farm.sim.scene import compiled
from farm.tasks.base import Channel
model = compiled({MJCF!r}, "ball")
touch = Channel(name="touch", kind="scalars", shape=(1,), geoms=("ball",), colours=((0, 0, 255),), top=2.0)
qpos, values = np.repeat(model.qpos0[None], 3, axis=0), {{"touch": np.array([[0.0], [0.001], [2.0]])}}
try:
    drawn = list(pictures(model, qpos, (40, 30), camera=None, channels=[touch], values=values))
except RunError as error:
    sys.exit(str(error))
assert (model.geom_rgba == [[0, 0, 0, 1]]).all(), "the physics' model is changed"
np.save(sys.stdout.buffer, np.array(drawn))
"""


def test_geometries_are_painted_by_a_channels_values(tmp_path):
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    done = subprocess.run([sys.executable, "-c", DRAW], env=environment, capture_output=True, check=False, timeout=60)
    if b"cannot draw here" in done.stderr:
        pytest.skip("no OSMesa and no EGL")
    (tmp_path / "drawn.npy").write_bytes(done.stdout)
    assert done.returncode == 0, done.stderr.decode()
    drawn = np.load(tmp_path / "drawn.npy").astype(int)
    assert drawn.shape == (3, 30, 40, 3)
    np.testing.assert_allclose(drawn[:, 0, 0], np.tile([240, 242, 245], (3, 1)), atol=2)
    untouched, lightest, full = drawn[:, 15, 20]
    assert np.ptp(untouched) < 10, "white"
    assert lightest[2] - lightest[0] > 50, "the lightest touch shows"
    assert full[2] > 150
    assert full[0] < 100


def test_the_light_leaves_the_model_alone():
    model = compiled(MJCF, "ball")
    before = model.vis.headlight.ambient.copy(), model.vis.global_.offwidth
    bright = lit(model, 2.0, (2000, 100))
    assert bright.vis.global_.offwidth == 4000
    assert bright.vis.headlight.ambient[0] != before[0][0]
    assert (model.vis.headlight.ambient.tolist(), model.vis.global_.offwidth) == (before[0].tolist(), before[1])
    np.testing.assert_array_equal(bright.body_mass, model.body_mass)


def test_a_scene_without_a_camera_is_seen_from_beside_what_moves():
    camera = beside(Scene(compiled(MJCF, "ball")))
    assert camera.lookat == (0.0, 0.0, 0.0)
    assert camera.distance == pytest.approx(AWAY * 0.5 * 3**0.5)
