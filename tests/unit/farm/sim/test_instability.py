"""What a model shows of why it becomes unstable, each on a model that has that fault and no
other.
"""

import mujoco
import numpy as np
import pytest

from farm.sim.instability import (
    WatchedEngine,
    bare_dofs,
    first_joint,
    outside,
    overlapping,
    too_stiff,
)

ARM = """<mujoco><option timestep="0.01"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" range="-90 90" limited="true" {0}/>
  <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="1"/><body name="lower" pos="0 0 .3">
  <joint axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass="0.01"/></body></body>
  </worldbody><actuator><position joint="shoulder" kp="{1}"/></actuator></mujoco>"""


def arm(joint: str = "", kp: float = 1.0) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_string(ARM.format(joint, kp))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def test_degrees_are_recognised():
    assert outside(arm(), np.array([[0.1, 9.0], [45.0, 9.0]])) == [
        "joint 'shoulder' of body 'upper' starts at 45 rad, outside -1.57 to 1.57: 0.785 rad, if"
        " degrees were meant"
    ]
    assert outside(arm(), np.array([[-150.0, 0.0]]))[0].endswith(
        "starts at -150 rad, outside -1.57 to 1.57"
    )
    assert outside(arm(), np.array([[1.5, 99.0], [-1.5, 0.0]])) == [], (
        "the other joint has no range"
    )


@pytest.mark.parametrize(("depth", "count"), [(0.02, 1), (0.0005, 0)])
def test_bodies_inside_each_other(depth, count):
    xml = f"""<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
        <body name="ball" pos="0 0 {0.1 - depth}">
      <freejoint/>
      <geom size="0.1"/></body><body name="far" pos="1 0 1">
          <geom size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    found = overlapping(model, model.qpos0, None)
    assert len(found) == count
    assert found == ["body 'world' and body 'ball' begin 20 mm inside each other"][:count]


def test_mocap_bodies_count_as_well():
    xml = """<mujoco><worldbody><body name="tool" mocap="true" pos="0 0 9"><geom size="0.1"/></body>
      <body name="ball"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    assert overlapping(model, model.qpos0, None) == []
    pose = np.array([[0.0, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0]])
    assert overlapping(model, model.qpos0, pose) == [
        "body 'tool' and body 'ball' begin 50 mm inside each other"
    ]


def test_servos_that_are_too_stiff_for_the_timestep():
    assert too_stiff(arm(kp=10.0)) == []
    [line] = too_stiff(arm(kp=5000.0))
    assert line.startswith("joint 'shoulder' of body 'upper' swings at ")
    assert "with stiffness 5e+03 and inertia" in line
    longest = float(line.partition("at most ")[2].partition(" s")[0])
    model = arm(kp=5000.0)
    model.opt.timestep = 0.95 * longest  # which is rounded
    assert too_stiff(model) == []


def test_joints_with_neither_damping_nor_armature():
    assert bare_dofs(arm()).tolist() == [0]
    assert bare_dofs(arm('armature="0.1"')).tolist() == []


def test_the_joint_that_left_first():
    model = arm(kp=5e7)
    engine = WatchedEngine(model, 4)
    rows = np.arange(3)
    engine.reset(rows)
    engine.field("qpos")[1, 0] = 0.3  # the others are at rest
    for _ in range(20):
        engine.step(rows, 5)
    assert engine.blown_up(rows).tolist() == [False, True, False]
    assert engine.first is not None
    assert first_joint(model, engine.first) in (
        "joint 'shoulder' of body 'upper'",
        "a joint of body 'lower'",
    )


def test_a_state_that_stays_stable_names_no_joint():
    model = arm()
    engine = WatchedEngine(model, 2)
    engine.reset(np.arange(1))
    engine.step(np.arange(1), 3)
    assert engine.first is None
