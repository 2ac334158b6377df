"""How many numbers an action has: by the actuators, by mocap bodies, or as the task says."""

from typing import Any

import numpy as np
import pytest

from farm.arrays import FloatArray
from farm.errors import ConfigError, FarmError
from farm.sim.channels import Quantity
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks import loop
from farm.tasks.actions import numbers
from farm.tasks.base import Task
from farm.tasks.probe import specification

JOINTS = """<body><joint name="a" axis="0 1 0"/><geom size=".1" pos="0 0 .3"/>
  <body pos="0 0 .3"><joint name="b" axis="0 1 0"/><geom size=".1" pos="0 0 .3"/></body></body>"""
MOCAP = '<body name="target" mocap="true"/>'
WITH_MOCAP = f"<mujoco><worldbody>{JOINTS}{MOCAP}</worldbody></mujoco>"
MOTORS = '<actuator><motor joint="a" ctrlrange="-2 2"/><motor joint="b"/></actuator>'


class Still(Task):
    """Two joints without actuators."""

    xml = f"<mujoco><worldbody>{JOINTS}</worldbody></mujoco>"
    steps, substeps = 3, 2

    def reward(self, sim: Sim, action: FloatArray) -> FloatArray:
        """0."""
        return np.zeros(len(sim))


class Moved(Still):
    """Their torques are the action."""

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Apply them, as many as there are."""
        sim.qfrc_applied[:, : action.shape[1]] = action
        return np.zeros((len(sim), sim.model.nu))


class Driven(Still):
    """Two motors."""

    xml = f"<mujoco><worldbody>{JOINTS}{MOCAP}</worldbody>{MOTORS}</mujoco>"


class Together(Driven):
    """One number for both motors."""

    actions = 1

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """The second joint does half of what the first does."""
        return super().act(sim, action @ np.array([[1.0, 0.5]]))


def of(kind: type[Task], **attributes: Any) -> Task:
    return type("Own", (kind,), attributes)()


@pytest.mark.parametrize(
    ("task", "size"),
    [
        (Driven(), 2),
        (Together(), 1),
        (of(Moved, actions=2), 2),
        (of(Moved, actions=(Quantity("torque", "N m"),)), 1),
        (of(Moved, xml=WITH_MOCAP), 3),
        (of(Moved, actions=2, xml=WITH_MOCAP), 2),
        (of(Moved, actions=5, xml=Driven.xml), 5),
    ],
)
def test_the_size_of_an_action(task: Task, size: int) -> None:
    if size in {3, 5}:
        type(task).act = lambda self, sim, action: np.zeros((len(sim), sim.model.nu))  # type: ignore[method-assign]
    assert task.action_size == size
    assert specification(task).action == size


def test_controls_of_fewer_numbers() -> None:
    task = Together()
    sim = Sim(BatchEngine(task.model, 2))

    def controls() -> FloatArray:
        batch = loop.Batch(task, sim, [None, None])
        batch.step(np.array([[0.5], [4.0]]))
        return sim.ctrl.copy()

    np.testing.assert_array_equal(loop.again(controls), [[1.0, 0.25], [2.0, 1.0]])


BAD = {
    "nothing": (
        of(Still),
        r"no actuator: say how many numbers an action has \(actions = 3\), and use them in act",
    ),
    "no act": (
        of(Still, actions=2),
        r"size 2, but the model has no actuators: give it act\(self, sim, action\)",
    ),
    "no act for the mocap body": (of(Still, xml=WITH_MOCAP), "size 3, but"),
    "fewer than actuators": (
        of(Driven, actions=1),
        r"size 1, but the model has 2 actuators: .* controls \(B, 2\) of",
    ),
    "super": (
        of(Driven, actions=1, act=lambda self, sim, action: Task.act(self, sim, action)),
        "Task.act got actions of 1 numbers; expected 2, one per actuator",
    ),
    "as they are": (
        of(Moved, actions=2, act=lambda self, sim, action: action),
        r"act gave an array of shape \(1, 2\)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_one_line(case: str) -> None:
    task, expected = BAD[case]
    with pytest.raises(FarmError, match=expected) as error:
        specification(task)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", [0, -1, True, 2.0, "three", None, 10_001, (1, 2)])
def test_what_is_no_size(value: object) -> None:
    with pytest.raises(
        ConfigError,
        match=r"actions is .*; expected a farm.ActionSpace, a number from 1 to 10000 or a tuple",
    ):
        specification(of(Together, actions=value))


@pytest.mark.parametrize(
    ("task", "names"),
    [
        (Driven(), ["a", "b"]),
        (Together(), ["action 0"]),
        (
            of(Moved, actions=(Quantity("torque", "N m"), Quantity("other", "N m"))),
            ["torque", "other"],
        ),
        (of(Moved, actions=[Quantity("torque", "N m")]), ["torque"]),
    ],
)
def test_the_names_of_its_numbers(task: Task, names: list[str]) -> None:
    described = numbers.described(task, task.action_size)
    assert [each.name for each in described] == names
    bounded = type(task).act is Task.act
    assert np.isfinite([described[0].low, described[0].high]).all() == bounded
