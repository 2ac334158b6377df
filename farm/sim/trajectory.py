"""One rollout as it is displayed: poses, actions, rewards and channels, frame by frame. Pure data."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from farm.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A rollout at control rate or at physics rate; frame 0 is its start.

    F frames, B drawn bodies (in the order of `Scene.bodies`), A actions, K reward terms; a rollout that ended early
    has fewer frames.
    """

    times: FloatArray
    """Time since the start [s], (F,)"""
    bodies: FloatArray
    """Position [m] and quaternion wxyz of each drawn body in the world, (F, B, 7)"""
    actions: FloatArray
    """The policy's actions that led there, (F, A); zero at the start"""
    terms: FloatArray
    """Reward terms of the control step that led there, (F, K); zero at the start"""
    channels: Mapping[str, FloatArray]
    """Values of the task's channels by name, (F, *shape)"""
    value: float
    """The rollout's return"""
    success: bool | None
    """Whether it succeeded; None if the task does not define success"""

    def arrays(self) -> dict[str, FloatArray]:
        """Every array over the frames but the times: bodies, actions, terms, then `channels/NAME`."""
        own = {"bodies": self.bodies, "actions": self.actions, "terms": self.terms}
        return own | {f"channels/{name}": values for name, values in self.channels.items()}


def joined(rollouts: Sequence[Trajectory]) -> Trajectory:
    """The frames of at least one rollout after another; return and success are the last one's."""
    last = rollouts[-1]
    own = ("times", "bodies", "actions", "terms")
    frames: dict[str, Any] = {name: np.concatenate([getattr(r, name) for r in rollouts]) for name in own}
    channels = {name: np.concatenate([r.channels[name] for r in rollouts]) for name in last.channels}
    return replace(last, **frames, channels=channels)
