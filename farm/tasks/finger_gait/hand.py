"""The Allegro hand as used by the task: names, order and ranges of joints and sensors.

Pure data. The hand's own figures are in `assets/README.md`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

FINGERS: Final = ("index", "middle", "thumb")
"""The fingers in use, in the order of every (..., 3) array."""

JOINTS: Final = (
    *("index_1", "index_2", "index_3"),
    *("middle_1", "middle_2", "middle_3"),
    *("thumb_2", "thumb_3"),
)
"""The controlled joints, in the order of every (..., 8) array."""

FINGER_JOINTS: Final = {"index": [0, 1, 2], "middle": [3, 4, 5], "thumb": [6, 7]}
"""Which of the controlled joints move a finger."""

LOWER: Final = np.array([-0.196, -0.174, -0.227, -0.196, -0.174, -0.227, -0.189, -0.162])
"""Lower joint limits [rad], (8,)."""

UPPER: Final = np.array([1.61, 1.709, 1.618, 1.61, 1.709, 1.618, 1.644, 1.719])
"""Upper joint limits [rad], (8,)."""

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
    """The hand's fixed set-up around an object, which the controller cannot change."""

    press: Mapping[str, float]
    """Force that a finger is commanded to press with [N]; weight and friction change the actual
    forces.
    """
    place: str | None = None
    """Position of the object's centre while the fingers close [m]; None: as in its file."""
    turned: Mapping[str, str] = field(default_factory=dict)
    """Orientations of links whose joints are fixed, by the link's body, quaternions wxyz; others
    as in hand.xml.
    """
    options: Mapping[str, str] = field(default_factory=dict)
    """Changed physics options, as attributes of MJCF's `option`."""


POSES: Final[Mapping[str, Pose]] = {
    "opposed": Pose(press={"index": 4.0, "middle": 3.0, "thumb": 6.5}),
    # Index and middle base turned by -0.14 and 0.14 rad, thumb base by 1.35 and thumb proximal by
    # 0.22 rad.
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
