"""The backend `cpu`: MuJoCo on this machine's processor, with one thread per worker."""

from typing import ClassVar

import mujoco

from farm.sim.engines import CAPACITY, BatchEngine


class CpuBackend:
    """Makes engines that step a batch of MuJoCo simulations."""

    capacity: ClassVar[int] = CAPACITY

    def engine(self, model: mujoco.MjModel) -> BatchEngine:
        """An engine for this model's simulations."""
        return BatchEngine(model, self.capacity)
