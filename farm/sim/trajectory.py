"""One rollout as it is displayed and sent: poses, actions, rewards and channels, frame by frame.

Pure data.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, FloatArray, array
from farm.returns import RETURN_FLOOR

_CHANNELS: Final = 100  # channels of a trajectory
_FRAMES: Final = ("times", "bodies", "actions", "terms")


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A rollout at control rate or at physics rate; frame 0 is its start.

    F frames, B drawn bodies (in the order of `Scene.bodies`), A actions, K reward terms; a rollout
    that ended early has fewer frames. All but the times are float32, as viewers draw them.
    """

    value: float
    """The rollout's return; nan if nothing scored it, `RETURN_FLOOR` if it failed"""
    success: bool | None
    """Whether the rollout succeeded; None if the task does not define success"""
    channels: dict[str, Any]
    """Values of the task's channels by name, (F, *shape)"""
    times: FloatArray = array("<f8", 1)
    """Time since the start [s], (F,)"""
    bodies: AnyArray = array("<f4", 3)
    """Position [m] and quaternion wxyz of each drawn body in the world, (F, B, 7)"""
    actions: AnyArray = array("<f4", 2)
    """The policy's actions that led there, (F, A); zero at the start"""
    terms: AnyArray = array("<f4", 2)
    """Reward terms of the control step that led there, (F, K); zero at the start"""

    def __post_init__(self) -> None:
        """Check that all arrays have the same number of frames, at ascending times.

        Their widths depend on the task.
        """
        if not len(self.times) or self.times[0] != 0.0 or (np.diff(self.times) <= 0.0).any():
            raise ValueError(f"{len(self.times)} frames whose times do not start at 0 and ascend")
        if len(self.channels) > _CHANNELS:
            raise ValueError(f"{len(self.channels)} channels")
        for name, values in self.arrays().items():
            if not isinstance(values, np.ndarray) or values.dtype != np.dtype("<f4"):
                raise ValueError(f"{str(name)[:40]} that is not an array of float32")
            if (
                not values.ndim
                or values.shape[0] != len(self.times)
                or not np.isfinite(values).all()
            ):
                raise ValueError(
                    f"{str(name)[:40]} of shape {values.shape} in {len(self.times)} frames, or not"
                    " finite"
                )

    @classmethod
    def of(
        cls,
        *,
        channels: Mapping[str, FloatArray],
        times: FloatArray,
        value: float,
        success: bool | None,
        **arrays: FloatArray,
    ) -> "Trajectory":
        """Make one of numbers in double precision; those that are not finite become large."""
        frames = {name: single(values) for name, values in arrays.items()}
        return cls(
            value=value,
            success=success,
            times=times,
            **frames,
            channels={name: single(values) for name, values in channels.items()},
        )

    @property
    def returned(self) -> float | None:
        """Return of the rollout; None if it failed, or nothing scored it."""
        return self.value if self.value > RETURN_FLOOR else None

    @property
    def verdict(self) -> str:
        """Return of the rollout in words: "return 3.200", "failed", or empty if it has no score."""
        if np.isnan(self.value):
            return ""
        return "failed" if self.value <= RETURN_FLOOR else f"return {self.value:.3f}"

    def caption(self, name: str) -> str:
        """Name of the rollout, and below it return and success, as far as they are known."""
        success = {True: "success", False: "no success", None: ""}[self.success]
        return "\n".join(filter(None, (name, ", ".join(filter(None, (self.verdict, success))))))

    def arrays(self) -> dict[str, AnyArray]:
        """Every array over the frames but the times: bodies, actions, terms, then
        `channels/NAME`.
        """
        arrays = {"bodies": self.bodies, "actions": self.actions, "terms": self.terms}
        return arrays | {f"channels/{name}": values for name, values in self.channels.items()}

    def fits(self, shapes: Mapping[str, tuple[int, ...]]) -> bool:
        """Whether the rollout has exactly these arrays with these shapes per frame."""
        return {name: values.shape[1:] for name, values in self.arrays().items()} == dict(shapes)

    @property
    def nbytes(self) -> int:
        """Size of its arrays [bytes]."""
        return self.times.nbytes + sum(values.nbytes for values in self.arrays().values())


def joined(rollouts: Sequence[Trajectory]) -> Trajectory:
    """The frames of at least one rollout after another, for drawing; return and success are the
    last one's.
    """
    out, names = object.__new__(Trajectory), rollouts[-1].channels
    frames: dict[str, Any] = {
        each: np.concatenate([getattr(r, each) for r in rollouts]) for each in _FRAMES
    }
    channels = {name: np.concatenate([r.channels[name] for r in rollouts]) for name in names}
    # unchecked: its times begin anew
    vars(out).update(vars(rollouts[-1]), **frames, channels=channels)
    return out


def single(values: AnyArray) -> AnyArray:
    """Numbers in single precision; those that are not finite become large."""
    return np.clip(np.nan_to_num(values, nan=-1e30), -1e30, 1e30).astype("<f4")
