"""Rollouts of which some are shown: the best, the worst, those that ended early."""

import numpy as np

from farm.arrays import BoolArray, FloatArray


class Ranked:
    """S rollouts with results."""

    @property
    def returns(self) -> FloatArray:
        """Return of each rollout, (S,)."""
        raise NotImplementedError

    @property
    def early(self) -> BoolArray:
        """Which rollouts the task ended before their last step, (S,)."""
        raise NotImplementedError

    def best(self, count: int) -> list[int]:
        """Indices of those with the highest returns, the highest first; of equal ones the first."""
        return np.argsort(-self.returns, kind="stable")[:count].tolist()

    def worst(self, count: int) -> list[int]:
        """Indices of those with the lowest returns, in ascending order; of equal ones the first."""
        return np.argsort(self.returns, kind="stable")[:count].tolist()

    def ended(self, count: int) -> list[int]:
        """Indices of the first that the task ended early, for example by a drop."""
        return np.flatnonzero(self.early)[:count].tolist()
