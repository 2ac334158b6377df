"""Moves of a site in space, by damped least squares."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.sim.channels import Quantity
from farm.sim.quantities import controls, of_joint
from farm.tasks.actions.offsets import pose
from farm.tasks.actions.space import ActionSpace, clipped, ranges, spread

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task

AXES: Final = ("x", "y", "z", "about x", "about y", "about z")
"""Directions of the world in which a site moves [m], and about which it turns [rad]."""

_TARGETS: Final = "moves"
_START: Final = "moves start"
_BACK: Final = 0.3  # share of the error along a held axis that a control step corrects
_SERVO: Final = ("rad", "m")


class Moves(ActionSpace):
    """Each number moves a site along, or about, an axis of the world; servos follow.

    With the site's Jacobian J (k, n) in the present state and a move e (k,), the targets of the
    joints' position servos change by J^T (J J^T + d^2 1)^-1 e: damped least squares (Wampler 1986,
    IEEE Transactions on Systems, Man, and Cybernetics 16(1)).

    Example:
      ```python
      import farm

      class Arm(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body>
                <joint name="a" axis="0 1 0"/><geom size="0.1"/>
                <body name="arm" pos="0.3 0 0">
                  <joint name="b" axis="0 1 0"/><geom size="0.1"/>
                  <site name="tip" pos="0.3 0 0"/>
                </body>
              </body>
            </worldbody>
            <actuator><position joint="a" kp="50"/><position joint="b" kp="50"/></actuator>
          </mujoco>'''
          actions = farm.Moves("tip", axes=("x", "z"), step=0.01)  # [m] in a control step

      assert [each.name for each in Arm().space.quantities] == ["tip x", "tip z"]
      ```
    """

    def __init__(
        self,
        site: str,
        axes: Sequence[str] = ("x", "y", "z"),
        step: float | Sequence[float] = 0.01,
        held: Sequence[str] = (),
        damping: float = 0.05,
    ) -> None:
        """Say what moves, and how far.

        Args:
          site: its name.
          axes: those of AXES along which the numbers move it.
          step: how far a number of 1 moves it in a control step, [m] or [rad]; one for all, or one
              for each.
          held: those of AXES along which it stays where it began.
          damping: d, in the Jacobian's units; larger: smoother near singular poses, and less exact.
        """
        self.site = site
        self.axes = tuple(axes)
        self.step = step
        self.held = tuple(held)
        self.damping = damping

    def fit(self, task: "Task") -> None:
        """Find site, joints and servos."""
        model = task.model
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, self.site) < 0:
            sites = ", ".join(model.site(i).name for i in range(model.nsite)) or "none"
            raise ConfigError(f"Moves: the model has no site {self.site!r}; it has {sites}")
        wrong = [axis for axis in (*self.axes, *self.held) if axis not in AXES]
        twice = [axis for axis in self.held if axis in self.axes]
        if wrong or twice or not self.axes:
            what = (
                f"{wrong[0]!r} is no axis"
                if wrong
                else "an axis is moved and held"
                if twice
                else "no axis is moved"
            )
            raise ConfigError(
                f"Moves: {what}; expected axes and held to be different ones of {', '.join(AXES)}"
            )
        if not self.damping > 0.0:
            raise ConfigError(f"Moves: damping is {self.damping:g}; expected a number above 0")
        self.body = model.body(int(model.site(self.site).bodyid[0])).name
        self.point = int(model.site(self.site).id)
        self.low, self.high = ranges(model)
        self.middle = pose(model, "")
        self.rows = np.array([AXES.index(axis) for axis in (*self.axes, *self.held)])
        self.far = spread("Moves", "step", self.step, len(self.axes))
        self._servos(model)
        self._check_alike(task.simulated)
        if not self.body:
            raise ConfigError(f"Moves: the body of site {self.site!r} has no name: give it one")
        self.quantities = tuple(
            Quantity(f"{self.site} {axis}", "", -1.0, 1.0) for axis in self.axes
        )

    def _servos(self, model: mujoco.MjModel) -> None:
        """Find the servos that move the site: actuators, and the qpos and qvel of their joints."""
        body = int(model.site(self.site).bodyid[0])
        above = set()
        while body:
            above.add(body)
            body = int(model.body_parentid[body])
        servos = []
        for i, quantity in enumerate(controls(model)):
            joint = of_joint(model, i)
            if (
                joint is not None
                and int(model.jnt_bodyid[joint]) in above
                and quantity.unit in _SERVO
            ):
                servos.append((i, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])))
        if not servos:
            raise ConfigError(f"Moves: no position servo moves site {self.site!r}")
        self.servos, self.qpos, self.qvel = (np.array(each) for each in zip(*servos, strict=True))

    def _check_alike(self, models: Sequence[mujoco.MjModel]) -> None:
        """Check that several models have the site, and what moves it, at the same places."""
        places = []
        for model in models:
            site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, self.site)
            joints = [of_joint(model, int(i)) for i in self.servos]
            places.append((site, joints, model.jnt_qposadr.tolist(), model.jnt_dofadr.tolist()))
        if any(each != places[0] for each in places):
            raise ConfigError(
                f"Moves: site {self.site!r}, or a joint that moves it, has another number in one of"
                " the task's models: give them sites, joints and actuators in the same order"
            )

    def begin(self, sim: "Sim") -> None:
        """Forget the start; it is known from the first control step on."""
        sim.own[_TARGETS] = np.tile(self.middle, (len(sim), 1))
        sim.own[_START] = np.zeros((len(sim), 12))

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Targets of the servos, (B, nu); other actuators stay at the model's start."""
        targets = sim.own[_TARGETS]
        place = sim.site_xpos[:, self.point]
        turned = sim.site_xmat[:, self.point].reshape(len(sim), 9)
        if sim.t == 0:
            targets[:, self.servos] = sim.qpos[:, self.qpos]
            sim.own[_START][:] = np.concatenate([place, turned], axis=1)
        error = np.empty((len(sim), len(self.rows)))
        error[:, : len(self.axes)] = self.far * clipped(action)
        if self.held:
            away = np.concatenate(
                [sim.own[_START][:, :3] - place, _turn(turned, sim.own[_START][:, 3:])], axis=1
            )
            error[:, len(self.axes) :] = _BACK * away[:, self.rows[len(self.axes) :]]
        moves, turns = sim.jac(self.body, place)
        # Of shape (B, k, n)
        jacobian = np.concatenate([moves, turns], axis=1)[:, self.rows][:, :, self.qvel]
        targets[:, self.servos] += _least_squares(jacobian, error, self.damping)
        np.minimum(np.maximum(targets, self.low, out=targets), self.high, out=targets)
        return targets.copy()


def _turn(now: FloatArray, then: FloatArray) -> FloatArray:
    """Rotation about the world's axes from one matrix (B, 9) to another, for small angles, (B, 3)
    [rad].
    """
    columns = np.swapaxes(now.reshape(-1, 3, 3), 1, 2)
    aims = np.swapaxes(then.reshape(-1, 3, 3), 1, 2)
    crossed = np.cross(columns, aims)
    return 0.5 * (crossed[:, 0] + crossed[:, 1] + crossed[:, 2])


def _least_squares(jacobian: FloatArray, error: FloatArray, damping: float) -> FloatArray:
    """J^T (J J^T + d^2 1)^-1 e of J (B, k, n) and e (B, k), (B, n).

    Solved by elimination without pivots, as the matrix is positive definite, in single operations
    whose rounding does not depend on a processor's or a library's order of sums.
    """
    size = jacobian.shape[1]
    square = np.multiply(jacobian[:, :, None, :], jacobian[:, None, :, :], order="C").sum(axis=-1)
    square[:, np.arange(size), np.arange(size)] += damping**2
    right = error.copy()
    for i in range(size):
        for j in range(i + 1, size):
            factor = square[:, j, i] / square[:, i, i]
            square[:, j] -= factor[:, None] * square[:, i]
            right[:, j] -= factor * right[:, i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            right[:, i] -= square[:, i, j] * right[:, j]
        right[:, i] /= square[:, i, i]
    out = np.zeros((len(jacobian), jacobian.shape[2]))
    for i in range(size):
        out += jacobian[:, i] * right[:, i : i + 1]
    return out
