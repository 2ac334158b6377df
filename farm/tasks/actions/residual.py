"""Corrections of a script, or of another action space."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import FloatArray, shaped
from farm.errors import ConfigError
from farm.sim.channels import Quantity
from farm.tasks.actions.space import (
    ActionSpace,
    Around,
    actuators,
    chosen,
    clipped,
    listed,
    ranges,
    spread,
)

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class Residual(Around):
    """The controls of a script or of another action space, plus corrections that are learnt.

    Source: Silver et al. 2018, Residual Policy Learning, arXiv:1812.06298.

    Example:
      ```python
      import numpy as np

      import farm

      class Hinge(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body><joint name="hinge" axis="0 1 0"/><geom size="0.1" pos="0 0 0.5"/></body>
            </worldbody>
            <actuator><motor joint="hinge" ctrlrange="-9 9"/></actuator>
          </mujoco>'''
          actions = farm.Residual("script", 0.5)

          def script(self, sim):  # controls (B, nu)
              return -3.0 * sim.qpos - sim.qvel

      assert [each.name for each in Hinge().space.quantities] == ["residual hinge"]
      ```
    """

    def __init__(
        self,
        of: ActionSpace | str,
        range: float | Sequence[float] = 0.25,
        actuators: Sequence[str] = (),
    ) -> None:
        """Say what is corrected, and how far.

        Args:
          of: an action space, whose numbers come first; or the name of a method of the task that
            takes `sim` and gives controls, (B, nu).
          range: how far a number of 1 moves a control, in its units; one for all, or one for each.
          actuators: patterns of the names of those that are corrected; all without any.
        """
        self.base = of
        self.range = range
        self.patterns = listed(actuators)

    def fit(self, task: "Task") -> None:
        """Find what is corrected."""
        self.of = Script(self.base) if isinstance(self.base, str) else self.base
        super().fit(task)
        self.which = chosen("Residual", task.model, self.patterns)
        self.reach = spread("Residual", "range", self.range, len(self.which))
        self.low, self.high = ranges(task.model)
        names = actuators(task.model)
        residuals = tuple(Quantity(f"residual {names[i]}", "", -1.0, 1.0) for i in self.which)
        self.quantities = (*self.of.quantities, *residuals)

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Corrected controls, within the actuators' ranges, (B, nu)."""
        out = np.array(self.of.controls(sim, action[:, : self.of.size]), dtype=float)
        out[:, self.which] += self.reach * clipped(action[:, self.of.size :])
        return np.minimum(np.maximum(out, self.low), self.high)


class Script(ActionSpace):
    """Controls of a task's method, without a number that is learnt."""

    def __init__(self, method: str) -> None:
        """Say the method's name."""
        self.method = method

    def fit(self, task: "Task") -> None:
        """Find the method."""
        call = getattr(task, self.method, None)
        if not callable(call):
            kind = type(task).__name__
            raise ConfigError(f"Residual: task {kind} has no method {self.method}(self, sim)")
        self.call = call
        self.count = task.model.nu

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:  # noqa: ARG002
        """Controls (B, nu) of the method."""
        return shaped(self.method, self.call(sim), (len(sim), self.count))
