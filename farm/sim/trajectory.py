"""One rollout as it is shown: where everything was and what was felt, frame by frame. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from farm.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A rollout at control rate or at physics rate; frame 0 is the moment of release, or of a reset.

    F frames, B drawn bodies (in the order of `Scene.bodies`); a rollout that ended early has fewer frames. Shapes
    are the finger gait's: an environment of Gymnasium has no joints (F, 0), no fingers (F, 0, ...), its actions as
    targets (F, A), and one term (F, 1).
    """

    times: FloatArray
    """Since the release [s], (F,)"""
    bodies: FloatArray
    """Position [m] and quaternion wxyz of each drawn body in the world, (F, B, 7)"""
    joints: FloatArray
    """Joint positions [rad], (F, 8)"""
    targets: FloatArray
    """Joint targets that led there [rad], (F, 8)"""
    images: FloatArray
    """Taxels [N], (F, 3, 18)"""
    points: FloatArray
    """Contact points in each fingertip's frame [fingertip radii], (F, 3, 3)"""
    terms: FloatArray
    """Reward terms of the control step that led there, (F, 5); zero at the release"""
    value: float
    """The rollout's return"""
    success: bool | None
    """Whether the gait succeeded; None where the task knows no success"""


def joined(rollouts: Sequence[Trajectory]) -> Trajectory:
    """The frames of at least one rollout after another; what is of a whole rollout is the last one's."""
    last = rollouts[-1]
    names = [field.name for field in fields(last) if isinstance(getattr(last, field.name), np.ndarray)]
    frames: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in rollouts]) for name in names}
    return replace(last, **frames)
