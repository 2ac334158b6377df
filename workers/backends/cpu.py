"""The backend `cpu`: mujoco.batch on this machine's processor, on one thread per worker."""

from typing import ClassVar

import mujoco

from farm.sim.engines import CAPACITY, BatchEngine


class CpuBackend:
    """Makes engines of mujoco.batch."""

    capacity: ClassVar[int] = CAPACITY

    def engine(self, model: mujoco.MjModel) -> BatchEngine:
        """Make room for a model's simulations."""
        return BatchEngine(model, self.capacity)
