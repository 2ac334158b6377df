"""Objects of the model by their names, and outputs of the present state, compared with plain
MuJoCo.
"""

from typing import Any

import mujoco
import numpy as np
import pytest

from farm.errors import TaskError
from farm.sim.engines import BatchEngine, DataEngine
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Batch, again

XML = """<mujoco><option timestep="0.01"/><worldbody>
  <geom name="floor" type="plane" size="5 5 1"/><body name="goal" mocap="true" pos="0 0 2"/>
  <body name="ball" pos="0 0 0.5"><freejoint name="free"/><geom name="ball" size="0.1" mass="1"/>
    <site name="top" pos="0 0 0.1"/>
    <body name="arm" pos="0.2 0 0"><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03" mass="0.1"/></body></body></worldbody>
  <tendon><fixed name="string"><joint joint="hinge" coef="2"/></fixed></tendon>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/>
  <framepos name="place" objtype="site" objname="top"/></sensor>
  </mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(XML)
FIELDS = {
    ("joint", "free"): ("qpos", "qvel", "qacc", "qfrc_applied", "xanchor"),
    ("joint", "hinge"): ("qpos", "qvel", "qfrc_actuator", "xaxis"),
    ("body", "ball"): ("xpos", "xquat", "xmat", "cvel", "xfrc_applied", "subtree_com"),
    ("body", "arm"): ("xpos", "xipos"),
    ("geom", "ball"): ("xpos", "xmat"),
    ("site", "top"): ("xpos", "xmat"),
    ("sensor", "angle"): ("data",),
    ("sensor", "place"): ("data",),
    ("actuator", "motor"): ("ctrl", "force", "length", "velocity"),
    ("tendon", "string"): ("length", "velocity"),
}


class Falls(Task):
    """A ball with an arm that falls, from a height of its own."""

    xml = XML
    steps, substeps = 6, 5

    def reset(self, sim, row, rng):
        """Written by name."""
        sim.joint("free").qpos[row, 2] += 0.0 if rng is None else rng.uniform(0.0, 0.3)
        sim.body("ball").xfrc_applied[row, 0] = 2.0

    def act(self, sim, action):
        """Written by name."""
        if sim.t == 3:
            sim.joint("hinge").qvel[:] = 1.0
        return super().act(sim, action)

    def reward(self, sim, action):
        """Its height."""
        return sim.body("ball").xpos[:, 2]


class Fresh(Falls):
    """The same, which looks at the present state in every step."""

    def observe(self, sim):
        """Where the ball is now."""
        sim.forward()
        return np.concatenate([super().observe(sim), sim.body("ball").xpos], axis=1)


@pytest.mark.parametrize("engine", [BatchEngine, DataEngine])
def test_objects_by_name_are_those_of_mujoco(engine: Any) -> None:
    sim, data = Sim(engine(MODEL)), mujoco.MjData(MODEL)

    def simulated() -> None:
        sim.begin(1)
        sim.joint("hinge").qpos[:] = 0.4
        sim.start(np.arange(1))
        sim.control(np.full((1, 1), 0.2))
        sim.step(70)
        for (kind, name), attributes in FIELDS.items():
            for attribute in attributes:
                view, reference = getattr(sim, kind)(name), getattr(data, kind)(name)
                values, expected = getattr(view, attribute), getattr(reference, attribute)
                assert values.shape == (1, *expected.shape)
                assert values[0].tobytes() == expected.tobytes(), (kind, name, attribute)
                assert (view.id, view.name) == (reference.id, name)

    data.joint("hinge").qpos[:] = 0.4
    mujoco.mj_forward(MODEL, data)
    data.ctrl[:] = 0.2
    mujoco.mj_step(MODEL, data, 70)
    again(simulated)


def test_a_name_is_live_and_of_the_rollouts_that_go_on() -> None:
    sim = Sim(BatchEngine(MODEL, 4))
    sim.begin(3)
    hinge = sim.joint("hinge")
    hinge.qpos[:, 0] = (1.0, 2.0, 3.0)
    sim.start(np.arange(3))
    sim.keep(np.array([True, False, True]))
    assert hinge.qpos.tolist() == [[1.0], [3.0]]
    with sim.writing() as states:
        hinge.qpos[1] = 5.0
    sim.write(states)
    assert hinge.qpos.tolist() == sim.qpos[:, 7:].tolist() == [[1.0], [5.0]]
    with pytest.raises(ValueError, match="read-only"):
        hinge.qpos[:] = 0.0


def test_what_is_not_there_is_one_line() -> None:
    sim = Sim(BatchEngine(MODEL, 1))
    sim.begin(1)
    with pytest.raises(TaskError, match=r"^the model has no joint 'hing'; it has free, hinge$"):
        sim.joint("hing")
    with pytest.raises(TaskError, match=r"^the model has no geom 'x'; it has floor, ball$"):
        sim.geom("x")
    with pytest.raises(TaskError, match="the model has no site None; it has top"):
        sim.site(None)  # type: ignore[arg-type]
    bare = Sim(BatchEngine(mujoco.MjModel.from_xml_string("<mujoco/>"), 1))
    with pytest.raises(TaskError, match="the model has no joint 'x'; it has none with a name"):
        bare.joint("x")
    with pytest.raises(
        AttributeError, match=r"a joint of sim has no 'angle'; it has .*qpos, qvel, xanchor, xaxis$"
    ):
        _ = sim.joint("hinge").angle
    with pytest.raises(
        AttributeError,
        match=r"sim.joint\('hinge'\).qpos is written in place: sim.joint\('hinge'\).qpos",
    ):
        sim.joint("hinge").qpos = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("engine", [BatchEngine, DataEngine])
def test_forward_gives_outputs_of_the_present_state_and_changes_none(engine: Any) -> None:
    task, plain = Fresh(), Falls()
    sim, other = Sim(engine(task.model)), Sim(engine(plain.model))
    seeds: list[Any] = [(1,)] if engine is DataEngine else [(1,), None, (1,), (2,)]
    data = mujoco.MjData(task.model)

    def simulated() -> Any:
        batch, without = Batch(task, sim, seeds), Batch(plain, other, seeds)
        while not batch.over:
            x, _ = batch.observe(), without.observe()
            for row in range(len(x)):
                data.qpos[:], data.mocap_pos[:] = sim.qpos[row], sim.mocap_pos[row]
                mujoco.mj_kinematics(task.model, data)
                assert x[row, -3:].tobytes() == data.body("ball").xpos.tobytes()
            if sim.t:
                assert (sim.body("ball").xpos != other.body("ball").xpos).any(), (
                    "outputs lag without it"
                )
            for each in (batch, without):
                each.step(np.full((len(seeds), 1), 0.5))
            for name in ("qpos", "qvel", "qacc_warmstart", "time"):
                assert getattr(sim, name).tobytes() == getattr(other, name).tobytes()
        return batch.rollouts(), without.rollouts()

    one, two = again(simulated)
    assert one.returns.tobytes() == two.returns.tobytes()


def test_forward_is_refused_while_states_are_written() -> None:
    class Late(Falls):
        def act(self, sim, action):
            sim.forward()
            return super().act(sim, action)

    task = Late()
    batch = Batch(task, Sim(BatchEngine(task.model, 1)), [None])
    with pytest.raises(
        TaskError,
        match=r"sim.forward\(\) in act: call it in observe; act then sees the same outputs",
    ):
        batch.step(np.zeros((1, 1)))


@pytest.mark.parametrize("engine", [BatchEngine, DataEngine])
def test_rays_and_jacobians_are_those_of_mujoco_in_the_present_state(engine: Any) -> None:
    count = engine(MODEL).size if engine is DataEngine else 3
    sim, data = Sim(engine(MODEL)), mujoco.MjData(MODEL)
    sim.begin(count)
    sim.joint("free").qpos[:, 2] = (0.5, 1.5, 1.0)[:count]
    sim.start(np.arange(count))
    sim.control(np.ones((count, 1)))
    sim.step(9)
    if count > 1:
        sim.keep(np.array([True, False, True]))
    points = np.array([[0.0, 0.0, 3.0], [0.25, 0.0, 3.0], [4.0, 9.0, 0.1]])
    ways = np.array([0.0, 0.0, -2.0])
    hits, (moves, turns) = sim.ray(points, ways), sim.jac("arm", np.array([0.1, 0.2, 0.3]))
    past, _ = sim.ray(np.repeat(points[None], len(sim), axis=0), ways, "ball")
    geom = np.zeros((1, 1), dtype=np.int32)
    jacp = np.zeros((3, MODEL.nv))
    jacr = np.zeros((3, MODEL.nv))
    for row in range(len(sim)):
        data.qpos[:] = sim.qpos[row]
        mujoco.mj_kinematics(MODEL, data)
        mujoco.mj_comPos(MODEL, data)
        for i, point in enumerate(points):
            assert hits[0][row, i] == mujoco.mj_ray(MODEL, data, point, ways, None, 1, -1, geom[0])
            assert hits[1][row, i] == geom[0, 0]
            assert past[row, i] == mujoco.mj_ray(
                MODEL, data, point, ways, None, 1, MODEL.body("ball").id, geom[0]
            )
        mujoco.mj_jac(MODEL, data, jacp, jacr, np.array([0.1, 0.2, 0.3]), MODEL.body("arm").id)
        assert moves[row].tobytes() + turns[row].tobytes() == jacp.tobytes() + jacr.tobytes()
    assert {-1, MODEL.geom("ball").id} < set(hits[1].ravel().tolist())
    assert (past[:, 0] > hits[0][:, 0]).all()


def test_rays_that_make_no_sense_are_one_line() -> None:
    sim = Sim(BatchEngine(MODEL, 1))
    sim.begin(1)
    with pytest.raises(TaskError, match="^a ray's direction is 0$"):
        sim.ray(np.zeros(3), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))
    with pytest.raises(
        TaskError, match="the model has no body 'hand'; it has world, goal, ball, arm"
    ):
        sim.ray(np.zeros(3), np.ones(3), "hand")
    with pytest.raises(TaskError, match="the model has no body 'hand'"):
        sim.jac("hand", np.zeros(3))
