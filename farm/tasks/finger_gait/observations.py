"""What the controller sees: the four state bases of the thesis (3.5.3).

Pure, batched. A new state base is one function here and one line in STATES.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.tasks.finger_gait.hand import FINGERS, JOINTS
from farm.tasks.finger_gait.touch import TAXELS


@dataclass(frozen=True)
class StateBase:
    """A state base: how many numbers, whether touch is needed, and how they are made."""

    size: int
    touch: bool
    """Whether it needs taxels and contact points (they cost time)."""
    observe: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    """(joints (B, 8) [rad], images (B, 3, 18) [N], contact points (B, 3, 3) [radii]) -> x (B, size)."""


def _joints(joints: FloatArray, images: FloatArray, points: FloatArray) -> FloatArray:  # noqa: ARG001
    return joints


def _joints_contacts(joints: FloatArray, images: FloatArray, points: FloatArray) -> FloatArray:  # noqa: ARG001
    return np.concatenate([joints, points.reshape(len(joints), -1)], axis=1)


def _tactile(joints: FloatArray, images: FloatArray, points: FloatArray) -> FloatArray:  # noqa: ARG001
    return images.reshape(len(joints), -1)


def _joints_tactile(joints: FloatArray, images: FloatArray, points: FloatArray) -> FloatArray:  # noqa: ARG001
    return np.concatenate([joints, images.reshape(len(joints), -1)], axis=1)


_POINTS, _IMAGES = 3 * len(FINGERS), TAXELS * len(FINGERS)

STATES: Final[dict[str, StateBase]] = {
    "joints": StateBase(len(JOINTS), False, _joints),
    "joints+contacts": StateBase(len(JOINTS) + _POINTS, True, _joints_contacts),
    "tactile": StateBase(_IMAGES, True, _tactile),
    "joints+tactile": StateBase(len(JOINTS) + _IMAGES, True, _joints_tactile),
}
"""State bases by name; 8, 17, 54 and 62 numbers."""
