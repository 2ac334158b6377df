"""The Allegro hand as the task sees it: names, order and ranges of what moves and what feels.

Pure. The figures of the hand itself stand in `assets/README.md`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

FINGERS: Final = ("index", "middle", "thumb")
"""The fingers that take part, in the order of every (..., 3) array."""

JOINTS: Final = (
    *("index_1", "index_2", "index_3"),
    *("middle_1", "middle_2", "middle_3"),
    *("thumb_2", "thumb_3"),
)
"""The controlled joints, in the order of every (..., 8) array."""

FINGER_JOINTS: Final = {"index": [0, 1, 2], "middle": [3, 4, 5], "thumb": [6, 7]}
"""Which of the controlled joints move a finger."""

LOWER: Final = np.array([-0.196, -0.174, -0.227, -0.196, -0.174, -0.227, -0.189, -0.162])
"""Lower ends of the joint ranges [rad], (8,)."""

UPPER: Final = np.array([1.61, 1.709, 1.618, 1.61, 1.709, 1.618, 1.644, 1.719])
"""Upper ends of the joint ranges [rad], (8,)."""

TIP_RADIUS: Final = 0.012
"""Radius of the half-spherical fingertips [m]."""

GRIPS: Final = {
    "index+thumb": ("index", "thumb"),
    "middle+thumb": ("middle", "thumb"),
    "index+middle+thumb": ("index", "middle", "thumb"),
}
"""Grips by name: the fingers that press the object."""


@dataclass(frozen=True)
class Pose:
    """How the hand is set up round an object: what the controller cannot move."""

    press: Mapping[str, float]
    """Force with which a finger is told to press [N]; the object's weight and friction share it out."""
    place: str | None = None
    """Where the object's centre hangs while the fingers close [m]; None: where its file says."""
    turned: Mapping[str, str] = field(default_factory=dict)
    """Orientations of links whose joints are fixed, by the link's body, quaternions wxyz; others as in hand.xml."""
    options: Mapping[str, str] = field(default_factory=dict)
    """What is other in the physics, as MJCF's `option` has it."""


POSES: Final[Mapping[str, Pose]] = {
    "opposed": Pose(press={"index": 4.0, "middle": 3.0, "thumb": 6.5}),
    # Index and middle base turned by -0.14 and 0.14 rad, thumb base by 1.35 and thumb proximal by 0.22 rad.
    "between": Pose(
        press={"index": 3.0, "middle": 3.0, "thumb": 5.0},
        place="0.08 0.0235 0.02",
        turned={
            "index_base": "0.99660155 -0.04351257 -0.00305086 -0.06987628",
            "middle_base": "0.997551 0 0 0.06994285",
            "thumb_base": "0.78070695 -0.62489732 0 0",
            "thumb_proximal": "0.9939561 0 0 0.1097783",
        },
        options={"impratio": "10"},
    ),
}
"""Set-ups by name: the thumb opposite the index finger, or between index and middle finger."""
