"""The compiled hand with each object: names, order and figures."""

import mujoco
import numpy as np
import pytest

from farm.errors import ConfigError
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.hand import (
    FINGER_JOINTS,
    FINGERS,
    GRIPS,
    JOINTS,
    LOWER,
    TIP_RADIUS,
    UPPER,
)
from farm.tasks.finger_gait.holding import TIMESTEP
from farm.tasks.finger_gait.model import CONTACT_WIDTH, CONTACTS
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig

BENT = np.array([0.47, 1.09, 0.88, 0.48, 1.11, 0.88, 0.70, 0.86])
LINKS = {  # kg: base, proximal, medial, distal with its tip
    "index": (0.0119, 0.065, 0.0355, 0.0096 + 0.0168),
    "middle": (0.0119, 0.065, 0.0355, 0.0096 + 0.0168),
    "ring": (0.0119, 0.065, 0.0355, 0.0096 + 0.0168),
    "thumb": (0.0176, 0.0119, 0.038, 0.0388 + 0.0168),
}


@pytest.fixture(scope="module", params=model.objects())
def scene(request):
    """Every object there is."""
    return FingerGait(FingerGaitConfig(object=request.param)).hand


@pytest.fixture(scope="module")
def data(scene):
    state = mujoco.MjData(scene.model)
    state.qpos[:8] = BENT
    mujoco.mj_forward(scene.model, state)
    return state


# ---------------- the hand as the rest of the program sees it


def test_joints_have_the_names_order_and_ranges_of_the_hand(scene):
    assert [scene.model.joint(i).name for i in range(8)] == list(JOINTS)
    assert [scene.model.actuator(i).name for i in range(scene.model.nu)] == list(JOINTS)
    for i, name in enumerate(JOINTS):
        joint = scene.model.joint(name)
        assert joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
        assert (joint.qposadr[0], joint.dofadr[0]) == (i, i)
        assert scene.model.actuator(name).trnid[0] == joint.id
    np.testing.assert_array_equal(scene.model.jnt_range[:8], np.stack([LOWER, UPPER], axis=1))
    np.testing.assert_allclose(
        scene.model.actuator_ctrlrange, np.stack([LOWER, UPPER], axis=1), atol=1e-12
    )
    assert scene.model.jnt_limited[:8].all()


def test_fingers_own_their_joints():
    assert [i for finger in FINGERS for i in FINGER_JOINTS[finger]] == list(range(8))
    for finger in FINGERS:
        assert all(JOINTS[i].startswith(f"{finger}_") for i in FINGER_JOINTS[finger])
    assert all(set(fingers) <= set(FINGERS) for fingers in GRIPS.values())
    assert all("+".join(fingers) == name for name, fingers in GRIPS.items())


def test_each_finger_moves_its_own_tip_only(scene, data):
    for f, finger in enumerate(FINGERS):
        jacobian = np.zeros((3, scene.model.nv))
        mujoco.mj_jacSite(scene.model, data, jacobian, None, scene.tip_sites[f])
        moving = np.flatnonzero(np.abs(jacobian).max(axis=0) > 1e-6)
        assert moving.tolist() == list(FINGER_JOINTS[finger])


def test_motors_are_position_servos_with_a_torque_limit(scene):
    np.testing.assert_array_equal(scene.model.actuator_forcerange, np.tile([-0.7, 0.7], (8, 1)))
    np.testing.assert_array_equal(scene.model.actuator_gainprm[:, 0], 3.0)
    np.testing.assert_array_equal(scene.model.actuator_biasprm[:, 1], -3.0)


def test_the_object_comes_last_and_free(scene):
    free = scene.model.joint(scene.model.njnt - 1)
    assert scene.model.njnt == 9
    assert free.name == "object"
    assert free.type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert (scene.model.nq, scene.model.nv) == (15, 14)
    assert free.qposadr[0] == 8
    assert scene.model.body_jntadr[scene.object_body] == free.id


def test_tips_are_spheres_of_the_tip_radius(scene, data):
    for f, finger in enumerate(FINGERS):
        geom, site = scene.tip_geoms[f], scene.tip_sites[f]
        assert scene.model.geom(geom).name == scene.model.site(site).name == f"{finger}_tip"
        assert scene.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        assert scene.model.geom_size[geom, 0] == TIP_RADIUS
        np.testing.assert_array_equal(data.geom_xpos[geom], data.site_xpos[site])
        np.testing.assert_array_equal(data.geom_xmat[geom], data.site_xmat[site])


def test_tip_frames_look_along_the_finger_and_to_the_object(scene, data):
    for f, finger in enumerate(FINGERS):
        axes = data.site_xmat[scene.tip_sites[f]].reshape(3, 3)
        towards = axes.T @ (data.xpos[scene.object_body] - data.site_xpos[scene.tip_sites[f]])
        assert towards[0] > 0, finger  # x is the side that closes on it
        along = axes.T @ (
            data.site_xpos[scene.tip_sites[f]] - data.xpos[scene.model.body(f"{finger}_distal").id]
        )
        np.testing.assert_allclose(along[:2], 0.0, atol=1e-9)
        assert along[2] > 0.02


def test_what_is_shown_of_a_link_touches_nothing_and_is_a_little_larger(scene):
    model = scene.model
    shells = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_shell")]
    assert len(shells) == (model.geom_group == 3).sum() == 15
    for i in shells:
        box = model.geom(model.geom(i).name.removesuffix("_shell")).id
        assert (model.geom_contype[i], model.geom_conaffinity[i]) == (0, 0)
        assert (model.geom_contype[box], model.geom_conaffinity[box]) == (1, 2)
        assert (model.geom_group[i], model.geom_group[box]) == (2, 3)
        assert model.geom_bodyid[i] == model.geom_bodyid[box]
        mesh, turned = model.geom_dataid[i], np.zeros(9)
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        mujoco.mju_quat2Mat(turned, model.geom_quat[i])  # MuJoCo turns a mesh to its principal axes
        vertices = model.mesh_vert[first : first + count] @ turned.reshape(3, 3).T
        larger = np.abs(vertices).max(axis=0) / model.geom_size[box]
        assert ((larger > 1.0) & (larger < 1.0201)).all()
        np.testing.assert_allclose(model.geom_pos[i], model.geom_pos[box], atol=1e-6)


# ---------------- figures


def test_masses_are_those_of_the_hand(scene):
    assert scene.model.body("palm").mass[0] == pytest.approx(0.4154)
    for finger, (base, proximal, medial, distal) in LINKS.items():
        masses = {
            part: scene.model.body(f"{finger}_{part}").mass[0]
            for part in ("proximal", "medial", "distal")
        }
        assert masses == pytest.approx({"proximal": proximal, "medial": medial, "distal": distal})
        bases = ("thumb_mount", "thumb_base") if finger == "thumb" else (f"{finger}_base",)
        assert sum(scene.model.body(name).mass[0] for name in bases) == pytest.approx(base)
    hand = scene.model.body_subtreemass[scene.model.body("palm").id]
    assert hand == pytest.approx(0.4154 + sum(sum(links) for links in LINKS.values()))


def test_the_hand_carries_its_own_weight_and_the_object_does_not(scene):
    weightless = scene.model.body_gravcomp
    parts = [
        i
        for i in range(scene.model.nbody)
        if scene.model.body(i).name not in ("world", "anchor", "object")
    ]
    assert (weightless[parts] == 1).all()
    assert weightless[scene.object_body] == 0
    assert 0.005 < scene.model.body_mass[scene.object_body] < 0.5


def test_time_and_gravity(scene):
    assert scene.model.opt.timestep == TIMESTEP == 0.01
    assert scene.model.opt.gravity.tolist() == [0, 0, -9.81]
    assert scene.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert scene.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


OFFSETS = {  # of each body in its parent [m]
    "index_base": ("palm", (0, 0.0435, -0.001542)),
    "middle_base": ("palm", (0, 0, 0.0007)),
    "ring_base": ("palm", (0, -0.0435, -0.001542)),
    "thumb_mount": ("palm", (-0.0182, 0.019333, -0.045987)),
    "thumb_proximal": ("thumb_base", (-0.027, 0.005, 0.0399)),
    "thumb_medial": ("thumb_proximal", (0, 0, 0.0177)),
    "thumb_distal": ("thumb_medial", (0, 0, 0.0514)),
    **{f"{f}_proximal": (f"{f}_base", (0, 0, 0.0164)) for f in ("index", "middle", "ring")},
    **{f"{f}_medial": (f"{f}_proximal", (0, 0, 0.054)) for f in ("index", "middle", "ring")},
    **{f"{f}_distal": (f"{f}_medial", (0, 0, 0.0384)) for f in ("index", "middle", "ring")},
}


def test_links_are_as_long_as_the_hands(scene):
    for name, (parent, offset) in OFFSETS.items():
        body = scene.model.body(name)
        assert scene.model.body(body.parentid[0]).name == parent, name
        np.testing.assert_allclose(body.pos, offset, atol=1e-12, err_msg=name)


def test_tips_are_as_far_out_as_the_hands(scene):
    for finger, reach in (("index", 0.0267), ("middle", 0.0267), ("thumb", 0.0423)):
        np.testing.assert_allclose(scene.model.site(f"{finger}_tip").pos, [0, 0, reach], atol=1e-12)


# ---------------- touch and freeze


def test_each_fingertip_feels_the_object_only(scene):
    for f, finger in enumerate(FINGERS):
        sensor = scene.model.sensor(finger)
        assert sensor.id == f
        assert (sensor.adr[0], sensor.dim[0]) == (
            f * CONTACTS * CONTACT_WIDTH,
            CONTACTS * CONTACT_WIDTH,
        )
        assert sensor.objid[0] == scene.tip_geoms[f]
        assert sensor.refid[0] == scene.object_body
    assert scene.model.nsensordata == 3 * CONTACTS * CONTACT_WIDTH


def test_the_freeze_holds_the_object_where_it_is(scene):
    state = mujoco.MjData(scene.model)
    state.mocap_pos[0], state.mocap_quat[0] = state.qpos[8:11], state.qpos[11:]
    before = state.qpos[8:].copy()
    for _ in range(100):
        mujoco.mj_step(scene.model, state)
    np.testing.assert_allclose(state.qpos[8:], before, atol=2e-3)
    state.eq_active[0] = 0
    for _ in range(50):
        mujoco.mj_step(scene.model, state)
    assert state.qpos[10] < before[2] - 0.05
    assert scene.model.equality(0).name == "freeze"
    assert scene.model.neq == 1


# ---------------- names


@pytest.mark.parametrize("name", ["spoon", "", "../hand", "BAR"])
def test_an_unknown_object_names_the_known_ones(name):
    with pytest.raises(ConfigError, match=f"unknown object {name!r}; known are .*bar"):
        FingerGait(FingerGaitConfig(object=name))
