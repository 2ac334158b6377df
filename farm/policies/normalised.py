"""A policy that sees standardised observations."""

import numpy as np

from farm.arrays import FloatArray
from farm.policies.base import Policy


class Normalised(Policy):
    """Wraps another policy, which gets (x - mean) / standard deviation of the observation x, number by number."""

    def __init__(self, policy: Policy, normaliser: FloatArray) -> None:
        """Take the policy, and mean and standard deviation (2, d)."""
        own = {"observation_mean": normaliser[0], "observation_deviation": normaliser[1]}
        super().__init__(policy.config, policy.spec, {**policy.constants, **own})
        self._policy, (self._mean, self._deviation) = policy, normaliser

    @property
    def size(self) -> int:
        """The size of the wrapped policy."""
        return self._policy.size

    def prepare(self, theta: FloatArray) -> FloatArray:
        """What the wrapped policy prepares."""
        return self._policy.prepare(theta)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """The actions of the wrapped policy."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._policy.act(prepared, (x - self._mean) / self._deviation)
