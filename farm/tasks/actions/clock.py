"""A clock that the policy sees, or by whose phase its weights change."""

import math
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import FloatArray
from farm.elementary import cos, sin
from farm.errors import ConfigError
from farm.sim.channels import Quantity
from farm.tasks.actions.space import ActionSpace, Actuators, Around, unit

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class Clock(Around):
    """A clock of a fixed period, for motions that repeat.

    Without `weights` the policy sees sine and cosine of the clock's phase. With K of them it sees
    its observation K times, each but two neighbours times 0, and a constant with each: a linear
    policy then has weights of its own for K phases, and between two phases those between them (gain
    scheduling).

    Example:
      ```python
      import farm

      class Hinge(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body><joint name="hinge"/><geom size="0.1"/></body>
            </worldbody>
            <actuator><motor joint="hinge"/></actuator>
          </mujoco>'''
          actions = farm.Clock(1.0, weights=4)  # learn with --policy linear --no-bias

      assert len(Hinge().space.names((farm.Quantity("angle"), farm.Quantity("speed")))) == 4 * 3
      ```
    """

    def __init__(self, period: float, weights: int = 0, of: ActionSpace | None = None) -> None:
        """Say how the clock runs.

        Args:
          period: of the clock [s].
          weights: phases with weights of their own, at least 2; 0: only sine and cosine are seen.
          of: what the action's numbers do; by default they are the actuators' ranges.
        """
        self.seconds = period
        self.weights = weights
        self.of = Actuators() if of is None else of

    def fit(self, task: "Task") -> None:
        """Check the numbers."""
        super().fit(task)
        self.period = task.period
        if not 2.0 * self.period <= self.seconds < math.inf:
            raise ConfigError(
                f"Clock: period is {self.seconds:g} s; expected at least two control steps,"
                f" {2.0 * self.period:g} s"
            )
        if type(self.weights) is not int or self.weights < 0 or self.weights == 1:
            raise ConfigError(
                f"Clock: weights is {self.weights!r}; expected 0, or a whole number of 2 or more"
            )
        self.quantities = self.of.quantities

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls of the other space, (B, nu)."""
        return self.of.controls(sim, action)

    def see(self, sim: "Sim", x: FloatArray) -> FloatArray:
        """The observation with the clock's phase, (B, n + 2), or in each phase's place, (B, K (n +
        1)).
        """
        x = super().see(sim, x)
        turns = (sim.t * self.period / self.seconds) % 1.0
        if not self.weights:
            angle = np.full((len(x), 1), 2.0 * math.pi * turns)
            return np.concatenate([x, sin(angle), cos(angle)], axis=1)
        place = turns * self.weights
        away = np.abs(np.arange(self.weights) - place)
        hats = np.maximum(1.0 - np.minimum(away, self.weights - away), 0.0)  # they add up to 1
        whole = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        return (hats[None, :, None] * whole[:, None, :]).reshape(len(x), -1)

    def names(self, observations: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
        """Names of what is seen."""
        inner = super().names(observations)
        if not self.weights:
            return (*inner, *unit(["clock sine", "clock cosine"]))
        whole = (*(each.name for each in inner), "1")
        return tuple(
            Quantity(f"{name} at phase {k}") for k in range(self.weights) for name in whole
        )
