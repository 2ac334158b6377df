"""Contact points and commands of a grip, found by simulation.

No number of a grip is given: each fingertip moves straight down (the thumb: up) onto the
object until it touches; from there the joint targets are chosen for the torques that press
with a given force, tau = J' F (for a position servo of stiffness k this is an offset tau / k
of its target).
"""

from typing import Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, LOWER, UPPER
from farm.tasks.finger_gait.model import Hand

WAIT: Final = 0.02
"""Height above its contact at which a finger outside the grip waits [m]."""

_APPROACH: Final = {"index": -1.0, "middle": -1.0, "thumb": 1.0}
"""Sign of a fingertip's vertical motion towards the object."""

_BENT: Final = np.array([0.47, 1.09, 0.88, 0.48, 1.11, 0.88, 0.70, 0.86])
"""Where the search for joint positions starts [rad]: fingers bent around a medium-sized object."""

_REACH: Final = 0.06
"""How far from the object's centre the approach starts [m]."""

_DAMPING: Final = 1e-8
"""Damping of the search for joint positions [m^2]: keeps the step of a stretched finger finite."""


class Grasping:
    """Inverse kinematics and contacts for one scene."""

    def __init__(self, scene: Hand) -> None:
        """Put the scene into its start configuration: hand bent, object in place."""
        self.scene = scene
        self.data = mujoco.MjData(scene.model)
        self.data.qpos[:8] = _BENT
        mujoco.mj_forward(scene.model, self.data)
        self.centre = self.data.xpos[scene.object_body].copy()
        self.contact = _BENT.copy()
        for finger in FINGERS:
            self.contact[FINGER_JOINTS[finger]] = self._touch(finger)

    def command(self, fingers: tuple[str, ...]) -> FloatArray:
        """Joint targets of a grip by these fingers while the others wait open [rad], (8,)."""
        targets = np.empty(8)
        for finger in FINGERS:
            joints = FINGER_JOINTS[finger]
            if finger in fingers:
                targets[joints] = self.contact[joints] + self._press(finger)
            else:
                targets[joints] = self.opened(finger)
        return np.clip(targets, LOWER, UPPER)

    def opened(self, finger: str) -> FloatArray:
        """Joint positions of a finger waiting over its contact [rad]."""
        self._place(finger, self.contact)
        site = self._site(finger)
        return self._reach(finger, self.data.site_xpos[site][2] - _APPROACH[finger] * WAIT)

    def _touch(self, finger: str) -> FloatArray:
        """Joint positions at which the fingertip just touches the object, by bisection of its
        height.
        """
        far = self.centre[2] - _APPROACH[finger] * _REACH
        near = self.centre[2]
        if self._distance(finger, far) <= 0:
            raise ConfigError(
                f"object {self.scene.object_name!r} is in the way of the {finger} finger's approach"
            )
        for _ in range(40):
            middle = 0.5 * (far + near)
            if self._distance(finger, middle) > 0:
                far = middle
            else:
                near = middle
        return self._reach(finger, far)

    def _distance(self, finger: str, height: float) -> float:
        """Gap between fingertip and object with the tip at that height [m]."""
        joints = FINGER_JOINTS[finger]
        self.data.qpos[joints] = self._reach(finger, height)
        mujoco.mj_kinematics(self.scene.model, self.data)
        tip = self.scene.tip_geoms[FINGERS.index(finger)]
        return min(
            mujoco.mj_geomDistance(self.scene.model, self.data, tip, geom, 1.0, None)
            for geom in self.scene.object_geoms
        )

    def _reach(self, finger: str, height: float) -> FloatArray:
        """Joint positions with the tip over (under) the object's centre line at a height: damped
        Gauss-Newton.
        """
        joints = FINGER_JOINTS[finger]
        site = self._site(finger)
        jacobian = np.empty((3, self.scene.model.nv))
        self._place(finger, _BENT)
        goal = np.array([self.centre[0], height])
        for _ in range(60):
            mujoco.mj_kinematics(self.scene.model, self.data)
            mujoco.mj_comPos(self.scene.model, self.data)
            error = goal - self.data.site_xpos[site][[0, 2]]
            mujoco.mj_jacSite(self.scene.model, self.data, jacobian, None, site)
            plane = jacobian[[0, 2]][:, joints]
            self.data.qpos[joints] += np.clip(_step(plane, error), -0.2, 0.2)
        return self.data.qpos[joints].copy()

    def _press(self, finger: str) -> FloatArray:
        """Target offsets that press with the pose's force along the approach: J' F / k [rad]."""
        joints = FINGER_JOINTS[finger]
        self._place(finger, self.contact)
        jacobian = np.empty((3, self.scene.model.nv))
        mujoco.mj_jacSite(self.scene.model, self.data, jacobian, None, self._site(finger))
        stiffness = self.scene.model.actuator_gainprm[joints, 0]
        return jacobian[2, joints] * _APPROACH[finger] * self.scene.pose.press[finger] / stiffness

    def _place(self, finger: str, joints: FloatArray) -> None:
        """Set one finger's joints, and reset the others: results never depend on earlier calls."""
        index = FINGER_JOINTS[finger]
        self.data.qpos[:8] = _BENT
        self.data.qpos[index] = joints[index]
        mujoco.mj_kinematics(self.scene.model, self.data)
        mujoco.mj_comPos(self.scene.model, self.data)

    def _site(self, finger: str) -> int:
        return self.scene.tip_sites[FINGERS.index(finger)]


def _step(jacobian: FloatArray, error: FloatArray) -> FloatArray:
    """J' (J J' + damping I)^-1 e for J (2, n) and e (2,) [m] -> (n,) [rad].

    Written out by Cramer's rule: a linear algebra library's rounding depends on the processor, and
    every grip needs it.
    """
    first, second = jacobian
    a = (first * first).sum() + _DAMPING
    b = (first * second).sum()
    c = (second * second).sum() + _DAMPING
    determinant = a * c - b * b
    return first * ((c * error[0] - b * error[1]) / determinant) + second * (
        (a * error[1] - b * error[0]) / determinant
    )
