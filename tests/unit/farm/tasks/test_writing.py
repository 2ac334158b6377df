"""Tasks that write states while their rollouts run: pushes, moving goals, jumps.

The same bits in any batch.
"""

from dataclasses import fields
from typing import Any

import mujoco
import numpy as np
import pytest

from farm.errors import TaskError
from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner
from farm.sim.engines import BatchEngine, DataEngine
from farm.sim.sim import WRITABLE, Sim
from farm.tasks.base import Task
from farm.tasks.loop import Batch
from farm.tasks.probe import specification
from farm.tasks.rollouts import Rollouts

XML = """<mujoco><option timestep="0.01"/><worldbody>
  <body name="goal" mocap="true" pos="0 0 2"><geom size="0.05" contype="0" conaffinity="0"/></body>
  <body name="cart" pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0"/>
  <geom size="0.1" mass="1"/>
    <body name="pole"><joint name="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02" mass="0.1"/></body></body></worldbody>
  <equality><joint joint1="slide" joint2="hinge" active="false"/></equality>
  <actuator><motor joint="slide"/><intvelocity joint="hinge" kp="1" actrange="-1 1"/></actuator>
      </mujoco>"""
PUSHED = 2  # the cart among the bodies


class Writer(Task):
    """Writes something from a step on that is drawn for each rollout; some rollouts end early."""

    xml = XML
    steps, substeps = 12, 4

    def prepare(self, sim, rngs):
        """Draw when and how much."""
        sim.own["when"] = np.array([4 if rng is None else int(rng.integers(1, 8)) for rng in rngs])
        sim.own["size"] = np.array([1.0 if rng is None else rng.uniform(0.5, 2.0) for rng in rngs])
        sim.own["ends"] = np.array(
            [99 if rng is None else int(rng.integers(3, 14)) for rng in rngs]
        )

    def act(self, sim, action):
        """Write in the rows whose step it is."""
        self.write(sim, sim.own["when"] == sim.t, sim.own["size"])
        return super().act(sim, action)

    def write(self, sim, now, size):
        """Nothing."""

    def observe(self, sim):
        """All of it."""
        return np.concatenate(
            [sim.qpos, sim.qvel, sim.act, sim.xpos[:, 1], sim.xfrc_applied[:, PUSHED, :1]], axis=1
        )

    def reward(self, sim, action):
        """Where everything is."""
        return sim.qpos.sum(axis=1) + sim.mocap_pos[:, 0, 0] + sim.qvel[:, 0]

    def ended(self, sim):
        """Where it was drawn."""
        return sim.t >= sim.own["ends"]


class Pushes(Writer):
    """Pushes the cart for two control steps."""

    def write(self, sim, now, size):
        """[N]; it stays until it is taken back."""
        sim.xfrc_applied[now, PUSHED, 0] = 20.0 * size[now]
        sim.xfrc_applied[sim.t == sim.own["when"] + 2, PUSHED] = 0.0


class Twists(Writer):
    """Applies a torque at the hinge from then on."""

    def write(self, sim, now, size):
        """[N m]"""
        sim.qfrc_applied[now, 1] = 0.1 * size[now]


class Moves(Writer):
    """Moves and turns the goal in every step."""

    def write(self, sim, now, size):
        """[m]"""
        sim.mocap_pos[:, 0, 0] += 0.01 * size
        sim.mocap_quat[:, 0] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))


class Jumps(Writer):
    """Puts the cart elsewhere, at rest."""

    def write(self, sim, now, size):
        """[m]"""
        sim.qpos[now, 0] = size[now]
        sim.qvel[now] = 0.0


class Couples(Writer):
    """Switches the equality on, and an actuator's own state back."""

    def write(self, sim, now, size):
        """The pole follows the cart."""
        sim.eq_active[now] = 1
        sim.act[now] = 0.1


class Feels(Jumps):
    """Also needs the whole data of each rollout, and the outputs of the present state."""

    def observe(self, sim):
        """With forces of contacts."""
        sim.forward()
        return np.concatenate([super().observe(sim), sim.contact_forces()[:, PUSHED]], axis=1)


WRITERS = [Pushes, Twists, Moves, Jumps, Couples, Feels]
SEEDS: list[Any] = [None, (1,), (1,), (2,), (3,), (4,), (5,), (6,)]


def new_runner(kind: type[Task]) -> Runner:
    task = kind()
    spec, config = specification(task), FeaturesConfig(features=10)
    return Runner(task, Direct(config, spec, Direct.draw(config, spec, np.random.default_rng(0))))


def same(one: Rollouts, row: int, other: Rollouts, at: int) -> None:
    for each in fields(one):
        values, others = getattr(one, each.name), getattr(other, each.name)
        for name in values if isinstance(values, dict) else [None]:
            pair = (values, others) if name is None else (values[name], others[name])
            assert pair[0][row].tobytes() == pair[1][at].tobytes(), (each.name, name)


@pytest.mark.parametrize("kind", WRITERS)
def test_what_a_task_writes_does_not_depend_on_the_batch(kind: type[Writer]) -> None:
    runner = new_runner(kind)
    theta = np.random.default_rng(1).normal(0.0, 2.0, (len(SEEDS), runner.size))
    together = runner.rollouts(theta, SEEDS)
    assert len(set(together.steps.tolist())) > 3, "rows are removed while others go on"
    order = [3, 6, 0, 7, 5, 1, 4, 2]
    permuted = runner.rollouts(theta[order], [SEEDS[i] for i in order])
    fine = runner.rollouts(theta, SEEDS, physics=True)
    assert fine.returns.tobytes() == together.returns.tobytes()
    for at, row in enumerate(order):
        same(together, row, permuted, at)
        same(together, row, new_runner(kind).rollouts(theta[row : row + 1], [SEEDS[row]]), 0)
    plain = new_runner(Writer).rollouts(theta, SEEDS)
    assert (plain.returns != together.returns).any(), "it counts"


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("engine", [BatchEngine, DataEngine])
def test_writing_is_that_of_a_plain_loop(kind: type[Writer], engine: Any) -> None:
    """What is written counts from the control step's first physics step on, and stays until it is
    changed.
    """
    task = kind()
    model, sim = task.model, Sim(engine(task.model))
    batch, data = Batch(task, sim, [None]), mujoco.MjData(model)
    for t in range(task.steps):
        batch.step(np.full((1, 2), 0.5))
        data.ctrl[:] = 0.5
        if t == 4:
            if kind is Pushes:
                data.xfrc_applied[PUSHED, 0] = 20.0
            elif kind is Twists:
                data.qfrc_applied[1] = 0.1
            elif issubclass(kind, Jumps):
                data.qpos[0], data.qvel[:] = 1.0, 0.0
            elif kind is Couples:
                data.eq_active[:], data.act[:] = 1, 0.1
        if t == 6 and kind is Pushes:
            data.xfrc_applied[PUSHED] = 0.0
        if kind is Moves:
            data.mocap_pos[0, 0] += 0.01
            data.mocap_quat[0] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
        for _ in range(task.substeps):
            mujoco.mj_step(model, data)
        for name in ("qpos", "qvel", "act", "xfrc_applied", "mocap_pos", "mocap_quat"):
            assert getattr(sim, name)[0].tobytes() == getattr(data, name).tobytes(), (t, name)


def wrong(method: str, write: Any) -> type[Task]:
    def does(self, sim, *more):
        write(sim)
        return getattr(super(kind, self), method)(sim, *more)

    kind: type[Task] = type("Wrong", (Writer,), {method: does})
    return kind


@pytest.mark.parametrize("name", ["xpos", "sensordata", "qacc", "time"])
def test_what_mujoco_computes_cannot_be_written(name: str) -> None:
    def write(sim):
        getattr(sim, name)[...] = 0.0

    with pytest.raises(
        TaskError,
        match=r"test_writing.py, line \d+, cannot write getattr\(sim, name\)\[...\] = 0.0: ",
    ):
        new_runner(wrong("act", write))


def put_site(sim):
    sim.xpos[:, 1] += 1.0


def put_control(sim):
    sim.ctrl[:] = 1.0


def put_friction(sim):
    sim.expand("geom_friction")[:, 0] = 1.0


def put_joint(sim):
    sim.joint("slide").qpos[:] = 1.0


def put_state(sim):
    sim.qvel[:] = 0.0


@pytest.mark.parametrize(
    ("method", "write", "line"),
    [
        (
            "act",
            put_site,
            r"cannot write sim.xpos\[:, 1\] \+= 1.0: sim.xpos is computed by MuJoCo; act can write "
            "sim.own and, of sim, qpos, qvel, act, .*xfrc_applied$",
        ),
        ("act", put_control, "act returns the controls"),
        (
            "act",
            put_friction,
            (
                "a field of the model can be written in reset and prepare only, before the rollout"
                " runs"
            ),
        ),
        (
            "reward",
            put_state,
            r"test_writing.py, line \d+, cannot write sim.qvel\[:\] = 0.0: sim.qvel can be written "
            "in act, reset and prepare only",
        ),
        (
            "reward",
            put_joint,
            r': sim.joint\("slide"\).qpos can be written in act, reset and prepare only',
        ),
        ("observe", put_state, "sim.qvel can be written in act, reset and prepare only"),
        ("ended", put_state, "sim.qvel can be written in act, reset and prepare only"),
    ],
)
def test_what_cannot_be_written_is_one_line(method: str, write: Any, line: str) -> None:
    with pytest.raises(TaskError, match=line):
        new_runner(wrong(method, write))


def test_an_array_that_was_kept_cannot_be_written_later() -> None:
    kept: dict[str, np.ndarray] = {}

    class Keeps(Writer):
        def write(self, sim, now, size):
            kept["qpos"] = sim.qpos

        def reward(self, sim, action):
            kept["qpos"][:] = 0.0
            return super().reward(sim, action)

    with pytest.raises(
        TaskError, match=r"cannot write kept\[.qpos.\]\[:\] = 0.0: the array is read-only"
    ):
        new_runner(Keeps)


def test_a_state_that_makes_no_sense_fails_alone() -> None:
    class Breaks(Writer):
        def write(self, sim, now, size):
            sim.qpos[size > 1.0, 0] = np.inf

    runner = new_runner(Breaks)
    rollouts = runner.rollouts(np.zeros((2, runner.size)), [(1,), None])
    assert rollouts.failed.tolist() == [True, False]


def test_all_that_can_be_written_is_a_state() -> None:
    engine = BatchEngine(Writer().model, 2)
    assert all(engine.field(name).flags.writeable for name in WRITABLE)
