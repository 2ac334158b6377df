"""The Allegro hand as the task sees it: names, order and ranges of what moves and what feels.

Pure. The figures of the hand itself stand in `assets/README.md`.
"""

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
