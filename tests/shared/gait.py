"""The finger gait without simulation: a test makes up what is measured."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from farm.tasks.finger_gait.observations import Felt
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig


@dataclass
class Frames:
    """Measured moments."""

    qpos: np.ndarray
    force: np.ndarray
    place: np.ndarray

    def dict(self) -> dict[str, np.ndarray]:
        """As the loop has them: the fingertips' frames are the world's."""
        return {"qpos": self.qpos, **in_the_world(self.force, self.place)}


class Touched(FingerGait):
    """Measures what a test gives it."""

    def measure(self, sim: Any) -> dict[str, np.ndarray]:
        """The test's own."""
        return in_the_world(sim.force, sim.place)


def in_the_world(force: np.ndarray, place: np.ndarray) -> dict[str, np.ndarray]:
    """Return what is measured of contacts at places in the fingertips' frames, which are the
    world's.
    """
    axes = np.broadcast_to(np.eye(3).ravel(), (*force.shape[:-1], 9))
    return {"force": force, "contact": place, "tip": np.zeros((*force.shape[:-1], 3)), "axes": axes}


def task(**options: Any) -> FingerGait:
    gait, rng = Touched(FingerGaitConfig(**options)), np.random.default_rng(0)
    gait.goals = [
        Felt(
            rng.uniform(0.3, 1.0, 8), rng.exponential(0.3, (3, 18)), rng.uniform(-0.5, 0.5, (3, 3))
        )
    ]
    gait.start_commands = np.linspace(0.3, 1.0, 8)[None]
    return gait
