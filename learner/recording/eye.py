"""From where a scene is seen in the viewer."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.sim.framing import View
from learner.recording.entities import FOLLOWED

_NEARER: Final = 0.88  # Rerun's eye sees a wider field than MuJoCo's camera


@dataclass(frozen=True)
class Eye:
    """The eye of a scene's view."""

    target: FloatArray
    """[m], (3,)"""
    away: FloatArray
    """Vector from the target to the eye [m], (3,)"""
    tracked: str | None = None
    """Entity that the eye follows."""

    @classmethod
    def of(cls, view: View) -> "Eye":
        """The eye of a point of view: it follows what that follows."""
        camera = view.camera
        a, e = np.deg2rad([camera.azimuth, camera.elevation])
        ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        tracked = None if view.mover is None else FOLLOWED
        return cls(np.array(camera.lookat), -_NEARER * camera.distance * ahead, tracked)
