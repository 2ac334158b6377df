"""Which parts of a compiled model are drawn, and where."""

import mujoco
import numpy as np
import pytest

from farm.errors import ConfigError
from farm.sim.model_files import compiled
from farm.sim.scene import Scene

MJCF = """
<mujoco>
  <asset>
    <material name="red" rgba="1 0 0 0.5"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 1 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="4 0 1"/>
    <geom name="hills" type="hfield" hfield="hills"/>
    <body name="post" pos="2 0 0"><geom type="cylinder" size="0.1 0.5" rgba="0 1 0 1"/></body>
    <body name="anchor" mocap="true" pos="3 0 0">
      <geom type="box" size="0.1 0.2 0.3" material="red"/>
      <body name="hung here"><geom type="ellipsoid" size="0.1 0.2 0.3"/></body>
    </body>
    <body pos="1 2 3">
      <freejoint/>
      <geom name="a/b" type="sphere" size="0.5" pos="0 0 1"/>
      <geom type="mesh" mesh="wedge"/>
      <geom name="hidden" type="box" size="1 1 1" group="3"/>
      <body name="nothing"><site name="s"/></body>
    </body>
    <body name="arm" pos="0 0 1" quat="0.8 0.6 0 0"><joint/>
    <geom type="capsule" size="0.1 0.4" pos="0 0 0.4"/></body>
  </worldbody>
</mujoco>
"""
SHOWN = (0, 2, 3, 4, 5, 6, 8)
"""Geometries that are drawn: a height field is not, nor is what only collides."""
BALL = (
    '<body name="ball" pos="1 2 3"><freejoint/><geom type="sphere" size="0.5" pos="0 0 1"/></body>'
)


@pytest.fixture(scope="module")
def scene():
    return Scene(compiled(MJCF, "made up"))


def test_bodies_are_those_that_have_a_shape(scene):
    assert scene.bodies == (
        "world",
        "post",
        "anchor",
        "hung here",
        "body_4",
        "arm",
    ), "in the model's order"
    assert scene.fixed == {"world", "post"}, "a mocap body and what hangs on it can be moved"
    assert scene.left_out == 1, "the hills"


def test_a_body_is_found_by_its_name_in_the_model(scene):
    assert scene.index("hung here") == 3
    for name in ("nothing", "leg"):
        with pytest.raises(
            ConfigError,
            match=f"no body '{name}' with a geometry in the model; known are world, post",
        ):
            scene.index(name)


def test_geometries_are_the_models(scene):
    geometries = scene.geometries()
    assert [g.shape for g in geometries] == [
        "plane",
        "cylinder",
        "box",
        "ellipsoid",
        "sphere",
        "mesh",
        "capsule",
    ]
    assert [g.name for g in geometries] == [
        "floor",
        "geom_2",
        "geom_3",
        "geom_4",
        "a/b",
        "geom_6",
        "geom_8",
    ]
    for i, geometry in zip(SHOWN, geometries, strict=True):
        geom = scene.model.geom(i)
        np.testing.assert_array_equal(geometry.size, geom.size)
        np.testing.assert_array_equal(geometry.position, geom.pos)
        np.testing.assert_array_equal(geometry.quaternion, geom.quat)
    colours = {g.name: g.colour for g in geometries}
    assert (colours["geom_2"], colours["geom_3"], colours["geom_4"]) == (
        (0, 1, 0, 1),
        (1, 0, 0, 0.5),
        (0.0, 114 / 255, 178 / 255, 1.0),
    ), "a body without a colour gets one"


def test_a_mesh_is_where_the_model_has_it(scene):
    [wedge] = [g for g in scene.geometries() if g.shape == "mesh"]
    assert (wedge.vertices.shape, wedge.faces.shape) == ((4, 3), (4, 3))
    placed = []
    for vertex in wedge.vertices:
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, vertex, np.array(wedge.quaternion))
        placed.append(turned + wedge.position)
    corners = [[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    np.testing.assert_allclose(sorted(np.round(placed, 6).tolist()), corners, atol=1e-6)


def test_poses_put_every_geometry_where_the_simulator_has_it(scene):
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(3, scene.model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    poses, data = scene.poses(qpos), mujoco.MjData(scene.model)
    assert poses.shape == (3, len(scene.bodies), 7)
    for frame in range(3):
        data.qpos[:] = qpos[frame]
        mujoco.mj_forward(scene.model, data)
        for i, geometry in zip(SHOWN, scene.geometries(), strict=True):
            pose, place = poses[frame, scene.bodies.index(geometry.body)], np.zeros(3)
            mujoco.mju_rotVecQuat(place, np.array(geometry.position), pose[3:])
            np.testing.assert_allclose(pose[:3] + place, data.geom_xpos[i], atol=1e-12)
    assert scene.poses(np.zeros((0, scene.model.nq))).shape == (0, len(scene.bodies), 7)


def test_what_moves_is_found():
    floor = '<geom type="plane" size="40 40 1"/>'
    mover = Scene(compiled(f"<mujoco><worldbody>{floor}{BALL}</worldbody></mujoco>", "")).mover
    assert (mover.centre, mover.body) == ((1.0, 2.0, 4.0), "ball")
    assert mover.radius == pytest.approx(0.5 * 3**0.5), "half the diagonal of the box around it"
    assert Scene(compiled(f"<mujoco><worldbody>{floor}</worldbody></mujoco>", "")).mover is None


@pytest.mark.parametrize(
    "mjcf", ["", "<mujoco", "<mujoco><worldbody><joint/></worldbody></mujoco>"]
)
def test_a_model_that_mujoco_refuses_is_one_line_with_its_name(mjcf):
    with pytest.raises(ConfigError, match="^mine.py: MuJoCo refuses the model: ") as refused:
        compiled(mjcf, "mine.py")
    assert "\n" not in str(refused.value)
