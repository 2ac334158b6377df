"""A few numbers that move many actuators together."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.tasks.actions.space import ActionSpace, Actuators, Around, clipped, unit

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class Synergies(Around):
    """Each number moves all actuators, or all numbers of another action space, by a row of weights.

    Source: postural synergies, Santello et al. 1998, Journal of Neuroscience 18(23).

    Example:
      ```python
      import numpy as np

      import farm

      class Fingers(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body>
                <joint name="a"/><geom size="0.1"/>
                <body><joint name="b"/><geom size="0.1"/></body>
              </body>
            </worldbody>
            <actuator>
              <motor joint="a" ctrlrange="-2 2"/>
              <motor joint="b" ctrlrange="-2 2"/>
            </actuator>
          </mujoco>'''
          actions = farm.Synergies([[1.0, 0.5]])  # one number closes both joints

      assert Fingers().action_size == 1
      ```
    """

    def __init__(
        self, weights: Sequence[Sequence[float]] | FloatArray, of: ActionSpace | None = None
    ) -> None:
        """Say what each number moves.

        Args:
          weights: (k, n); row i is what number i adds to the other space's n numbers.
          of: the other space; by default the actuators' ranges.
        """
        self.weights = np.asarray(weights, dtype=float)
        self.of = Actuators() if of is None else of

    def fit(self, task: "Task") -> None:
        """Check the weights."""
        super().fit(task)
        if self.weights.ndim != 2 or self.weights.shape[1] != self.of.size or not len(self.weights):
            raise ConfigError(
                f"Synergies: weights have shape {self.weights.shape}; expected (k, {self.of.size}),"
                " a row for each number of an action"
            )
        if not np.isfinite(self.weights).all():
            raise ConfigError("Synergies: a weight is not finite")
        self.quantities = unit([f"synergy {i}" for i in range(len(self.weights))])

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls of the other space, (B, nu)."""
        moved = np.multiply(self.weights.T[None], clipped(action)[:, None, :], order="C")
        return self.of.controls(sim, moved.sum(axis=-1))
