"""Offsets from a pose."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.sim.quantities import is_servo, of_joint
from farm.tasks.actions.space import (
    ActionSpace,
    actuators,
    chosen,
    clipped,
    listed,
    ranges,
    spread,
    unit,
)

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class Offsets(ActionSpace):
    """Each number moves an actuator's control away from a pose, by at most a range on both sides.

    Learning begins where the robot stands or holds, and the first steps explore around it.

    Example:
      ```python
      import farm

      class Arm(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body><joint name="elbow" range="-90 90"/><geom size="0.1"/></body>
            </worldbody>
            <actuator><position joint="elbow" kp="5" inheritrange="1"/></actuator>
            <keyframe><key name="bent" qpos="0.7"/></keyframe>
          </mujoco>'''
          actions = farm.Offsets("bent", 0.3)  # [rad]

      assert Arm().space.pose.tolist() == [0.7]
      ```
    """

    def __init__(
        self,
        pose: str | Sequence[float] = "",
        range: float | Sequence[float] = 0.5,
        actuators: Sequence[str] = (),
    ) -> None:
        """Say where the middle is, and how far the numbers reach.

        Args:
          pose: the middle: a keyframe of the model, or the control of each actuator, (nu,); empty:
            the model's own start. Of a keyframe without controls, servos have the joints'
            positions.
          range: how far a number of 1 moves a control, in its units; one for all, or one for each.
          actuators: patterns of the actuators' names, such as `FR_*`; the others stay in the pose.
        """
        self.where = pose
        self.range = range
        self.patterns = listed(actuators)

    def fit(self, task: "Task") -> None:
        """Find the pose and the actuators."""
        model = task.model
        self.which = chosen("Offsets", model, self.patterns)
        self.low, self.high = ranges(model)
        self.pose = pose(model, self.where)
        names = actuators(model)
        self.quantities = unit([names[i] for i in self.which])
        self.reach = spread("Offsets", "range", self.range, len(self.which))

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """The pose with the offsets, within the actuators' ranges, (B, nu)."""
        out = np.tile(self.pose, (len(sim), 1))
        out[:, self.which] += self.reach * clipped(action)
        return np.minimum(np.maximum(out, self.low), self.high)


def pose(model: mujoco.MjModel, where: str | Sequence[float]) -> FloatArray:
    """Controls of a pose (nu,): of a keyframe's name, as given, or (empty) of the model's start.

    Raises:
      ConfigError: there is no such keyframe, or another number of controls.
    """
    if not isinstance(where, str):
        values = np.asarray(where, dtype=float)
        if values.shape != (model.nu,) or not np.isfinite(values).all():
            raise ConfigError(
                f"pose is {where!r:.60}; expected {model.nu} numbers, one per actuator"
            )
        return values
    if not where:
        return _held(model, model.qpos0)
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, where) < 0:
        keyframes = ", ".join(model.key(i).name for i in range(model.nkey)) or "none"
        raise ConfigError(f"the model has no keyframe {where!r}; it has {keyframes}")
    key = model.key(where)
    return np.array(key.ctrl) if np.any(key.ctrl) else _held(model, key.qpos)


def _held(model: mujoco.MjModel, qpos: FloatArray) -> FloatArray:
    """Controls with which servos hold positions (nq,); 0 for other actuators."""
    out = np.zeros(model.nu)
    for i in range(model.nu):
        joint = of_joint(model, i)
        if joint is not None and is_servo(model, i):
            out[i] = model.actuator_gear[i, 0] * qpos[model.jnt_qposadr[joint]]
    return out
