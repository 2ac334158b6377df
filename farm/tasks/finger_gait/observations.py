"""The hand's sensor values, and the state bases that select from them: the thesis' four (3.5.3),
and three more.

Pure functions of batches. A new state base is one line in STATES.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.sim.channels import Quantity
from farm.tasks.finger_gait.hand import FINGERS, JOINTS, LOWER, UPPER
from farm.tasks.finger_gait.touch import TAXELS

_COUNT: Final = len(FINGERS)
_SIZES: Final = {
    "joints": len(JOINTS),
    "images": TAXELS * _COUNT,
    "points": 3 * _COUNT,
    "forces": _COUNT,
    "behind": len(JOINTS),
}


@dataclass(frozen=True)
class Felt:
    """Sensor values of the hand at any number of times.

    Those of the goal grip are its demonstration.
    """

    joints: FloatArray
    """q [rad], (..., 8)"""
    images: FloatArray
    """c [N], (..., 3, 18)"""
    points: FloatArray
    """CP, the contact points [radii], (..., 3, 3)"""
    behind: FloatArray = field(default_factory=lambda: np.empty(0))
    """The servos' deflections from their zero [N], (..., 8)"""

    @property
    def forces(self) -> FloatArray:
        """Total force on each fingertip [N], (..., 3)."""
        return self.images.sum(axis=-1)


@dataclass(frozen=True)
class StateBase:
    """A state base: sensor values of these kinds, concatenated."""

    parts: tuple[str, ...]
    """Names of the kinds of sensor values."""

    @property
    def size(self) -> int:
        """Length d of the observation."""
        return sum(self.sizes)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Lengths of the observation's parts."""
        return tuple(_SIZES[part] for part in self.parts)

    def quantities(self, scales: tuple[float, float, float]) -> tuple[Quantity, ...]:
        """Name, unit and range of each number, with the factors of joint positions, contact points
        and forces.
        """
        joints, points, force = scales
        angles = zip(JOINTS, LOWER * joints, UPPER * joints, strict=True)
        taxels, axes = [f"taxel {i}" for i in range(TAXELS)], [f"contact {axis}" for axis in "xyz"]
        forces = _times(force, "N"), 0.0
        quantities = {
            "joints": [
                Quantity(name, _times(joints, "rad"), *map(float, bounds))
                for name, *bounds in angles
            ],
            "images": [
                Quantity(f"{finger} {name}", *forces) for finger in FINGERS for name in taxels
            ],
            "points": [
                Quantity(f"{finger} {axis}", _times(points, "radii"), -points, points)
                for finger in FINGERS
                for axis in axes
            ],
            "forces": [Quantity(f"{finger} force", *forces) for finger in FINGERS],
            "behind": [Quantity(f"{name} deflection", "N") for name in JOINTS],
        }
        return tuple(each for part in self.parts for each in quantities[part])

    @property
    def touch(self) -> bool:
        """Whether the observation needs taxels or contact points, which take time to compute."""
        return self.parts not in (("joints",), ("behind",))

    @property
    def zeroed(self) -> bool:
        """Whether a rollout begins by holding still to find the servos' zero."""
        return "behind" in self.parts

    def observe(self, felt: Felt) -> FloatArray:
        """The observation x at B times, (B, d)."""
        count = len(felt.joints)
        return np.concatenate(
            [getattr(felt, part).reshape(count, -1) for part in self.parts], axis=1
        )


def _times(factor: float, unit: str) -> str:
    """Unit of a number that is scaled by a factor."""
    return unit if factor == 1.0 else f"{1.0 / factor:g} {unit}"


STATES: Final[dict[str, StateBase]] = {
    "joints": StateBase(("joints",)),
    "joints+contacts": StateBase(("joints", "points")),
    "tactile": StateBase(("images",)),
    "joints+tactile": StateBase(("joints", "images")),
    "forces": StateBase(("forces",)),
    "cop": StateBase(("points", "forces")),
    "zeroed": StateBase(("behind",)),
}
"""State bases by name; 8, 17, 54, 62, 3, 12 and 8 numbers. The first four are the thesis'."""
