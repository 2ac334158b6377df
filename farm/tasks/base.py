"""What both sides must know of a task before anything is simulated. Pure."""

from dataclasses import dataclass

from farm.arrays import FloatArray
from farm.tasks.finger_gait.touch import TAXELS


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How large a task's numbers are, and what it has."""

    observation: int
    """Length d of the state x."""
    lower: FloatArray
    """Least action, (A,)."""
    upper: FloatArray
    """Greatest action, (A,)."""
    steps: int
    """Control steps of a rollout, at most."""
    period: float
    """A control step [s]."""
    terms: tuple[str, ...]
    """What a reward is made of."""
    joints: int = 0
    """Joint positions that a trajectory shows."""
    fingers: int = 0
    """Fingertips that feel; with them there are tactile traces."""
    success: bool = False
    """Whether a rollout succeeds or does not; else there are returns alone."""
    release: str = ""
    """Release of the package that the task comes from, empty for the farm's own."""

    def shapes(self, bodies: int) -> dict[str, tuple[int, ...]]:
        """Shape of a frame of each of a trajectory's arrays, where so many bodies are drawn."""
        return {
            "bodies": (bodies, 7),
            "joints": (self.joints,),
            "targets": (len(self.lower),),
            "images": (self.fingers, TAXELS),
            "points": (self.fingers, 3),
            "terms": (len(self.terms),),
        }
