"""A policy whose observations are standardised."""

import numpy as np

from farm.arrays import FloatArray
from farm.policies.base import Graph, Policy


class Normalised(Policy):
    """Wraps a policy, which then gets (x - mean) / standard deviation for each number of the
    observation x.
    """

    def __init__(self, policy: Policy, normaliser: FloatArray) -> None:
        """Take the policy, and mean and standard deviation (2, d)."""
        constants = {"observation_mean": normaliser[0], "observation_deviation": normaliser[1]}
        super().__init__(policy.config, policy.spec, {**policy.constants, **constants})
        self._policy, (self._mean, self._deviation) = policy, normaliser

    @property
    def size(self) -> int:
        """The size of the wrapped policy."""
        return self._policy.size

    @property
    def scale(self) -> FloatArray | None:
        """The scale of the wrapped policy."""
        return self._policy.scale

    @property
    def memory(self) -> FloatArray | None:
        """The memory of the wrapped policy."""
        return self._policy.memory

    def prepare(self, theta: FloatArray) -> FloatArray:
        """The result of the wrapped policy's `prepare`."""
        return self._policy.prepare(theta)

    def act(self, prepared: FloatArray, x: FloatArray, *memory: FloatArray) -> FloatArray:
        """Return the wrapped policy's actions for standardised observations."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._policy.act(prepared, (x - self._mean) / self._deviation, *memory)

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str | tuple[str, str]:
        """Add the standardisation and then the wrapped policy to a graph; return what the wrapped
        policy's `onnx` returns.
        """
        standard = graph.put("Div", graph.put("Sub", x, self._mean), self._deviation)
        return self._policy.onnx(graph, theta, standard, memory)
