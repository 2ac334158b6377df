"""Origin and spread of a task's observations."""

from typing import Any

import numpy as np
import pytest

from farm.errors import TaskError
from farm.tasks.base import Task
from farm.tasks.standard import nominal, standard


class Cart(Task):
    """A cart, a number that never moves, and its place in another unit."""

    xml = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="x" ctrlrange="-2 2"/></actuator></mujoco>"""
    steps, substeps = 20, 5
    unit = 1.0

    def reset(self, sim: Any, row: int, rng: np.random.Generator | None) -> None:
        sim.qpos[row] = 0.5

    def observe(self, sim: Any) -> np.ndarray:
        place = sim.qpos[:, :1]
        return np.concatenate(
            [place, np.full_like(place, 7.0), self.unit * place, np.zeros_like(place)], axis=1
        )

    def reward(self, sim: Any, action: np.ndarray) -> np.ndarray:
        return -np.abs(sim.qpos[:, 0])


def test_origin_and_spread() -> None:
    task = Cart()
    np.testing.assert_array_equal(nominal(task), [0.5, 7.0, 0.5, 0.0])
    constants = standard(task, 0.25)
    np.testing.assert_array_equal(constants["origin"], nominal(task))
    spread = constants["spread"][0]
    assert 0.001 < spread < 0.5
    # A third of the mean.
    np.testing.assert_allclose(
        constants["spread"], [spread, spread * 2 / 12, spread, spread * 2 / 12]
    )
    again = standard(Cart(), 0.25)
    assert again["spread"].tobytes() == constants["spread"].tobytes()


def test_parts_are_measured_by_themselves() -> None:
    task = Cart()
    task.unit, task.parts = 1000.0, (2, 1, 1)
    base, still, large, nothing = standard(task, 0.25)["spread"]
    assert still == pytest.approx(base / 6)
    assert large == pytest.approx(1000 * base)
    assert nothing == 1.0


def test_an_observation_that_is_no_number() -> None:
    task = Cart()
    task.unit = np.nan
    with pytest.raises(TaskError, match="observe is not finite"):
        nominal(task)
