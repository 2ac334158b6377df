"""Controllers of signed radial functions. Pure, batched.

    rbf                a_i = sum_k w_ik exp(-|x - c_k|^2 / (2 h^2)),  k = 1..K
                       K (d + A) parameters (Broomhead & Lowe 1988, Multivariable functional
                       interpolation and adaptive networks); the centres c_k serve all actions
    weighted-kernel    a_i = w_i exp(-|theta_i - y|^2 / (2 h^2)),
                       y = (x - m) / s,  h = width sqrt(d)
                       A (d + 1) parameters (ours): the kernel controller with a sign, in units of
                       the observation

m is the observation at the nominal start and s its spread (`farm/tasks/standard.py`). In these
units a search that begins with theta = 0, w = 0 and the same sigma for all parameters suits any
task; it searches v in w = weight_scale v.

A sum runs over its own row, in an order that depends only on the row's length; exp is that of
`farm/elementary.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.policies.base import Graph, Policy, PolicyConfig, check_constants
from farm.policies.fourier import gaussian_exponents, gaussians
from farm.settings import setting
from farm.tasks.base import TaskSpec


@dataclass(frozen=True, kw_only=True)
class RbfConfig(PolicyConfig):
    """Settings of the radial basis functions."""

    centres: int = setting(8, least=1, most=100_000)
    """Number of radial functions, K."""
    bandwidth: float = setting(1.0, above=0.0)
    """Width h of each function, in units of the observation."""


@dataclass(frozen=True, kw_only=True)
class WeightedKernelConfig(PolicyConfig):
    """Settings of the weighted kernel."""

    width: float = setting(1.77, above=0.0)
    """Width of the Gaussian, in units of sqrt(d) spreads of the observation."""
    weight_scale: float = setting(0.25, above=0.0)
    """Action of a weight parameter of 1."""


class Rbf(Policy):
    """Radial basis functions: a_i = sum_k w_ik exp(-|x - c_k|^2 / (2 h^2))."""

    Config: ClassVar[type[PolicyConfig]] = RbfConfig

    @property
    def size(self) -> int:
        """K (d + A): the centres, then each action's weights."""
        return int(self.config.centres * (self.spec.observation + self.spec.action))

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions; as large as the weights."""
        count, split = self.config.centres, self.config.centres * self.spec.observation
        values = _gaussians(
            prepared[:, :split].reshape(len(prepared), count, -1), x, self.config.bandwidth
        )
        weights = np.ascontiguousarray(
            prepared[:, split:].reshape(len(prepared), self.spec.action, count)
        )
        with np.errstate(over="ignore", invalid="ignore"):
            return (weights * values[:, None, :]).sum(axis=-1)

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str:  # noqa: ARG002
        """Add the radial functions and their weights to a graph; return the output's name."""
        centres, weights = np.split(theta, [self.config.centres * self.spec.observation])
        values = gaussians(
            graph, x, centres.reshape(-1, self.spec.observation), self.config.bandwidth
        )
        return graph.put("MatMul", values, weights.reshape(self.spec.action, -1).T.copy())


class WeightedKernel(Policy):
    """Signed Gaussian kernel of the standardised observation: a_i = w_i exp(-|theta_i - y|^2 / (2
    h^2)).
    """

    Config: ClassVar[type[PolicyConfig]] = WeightedKernelConfig
    standardised: ClassVar[bool] = True

    def __init__(
        self, config: PolicyConfig, spec: TaskSpec, constants: Mapping[str, FloatArray]
    ) -> None:
        """Take the settings, the task's sizes, and the constants m (`origin`) and s (`spread`)."""
        super().__init__(config, spec, constants)
        check_constants(constants, {"origin": (spec.observation,), "spread": (spec.observation,)})
        self._bandwidth = self.config.width * np.sqrt(spec.observation)

    @property
    def size(self) -> int:
        """A (d + 1): each action's centre, then its weight."""
        return self.spec.action * (self.spec.observation + 1)

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Centre and weight of each action, (B, A, d + 1)."""
        return np.ascontiguousarray(theta).reshape(len(theta), self.spec.action, -1)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions; as large as the weights."""
        with np.errstate(over="ignore", invalid="ignore"):
            y = (x - self.constants["origin"]) / self.constants["spread"]
            weights: FloatArray = self.config.weight_scale * prepared[:, :, -1]
            return weights * _gaussians(prepared[:, :, :-1], y, self._bandwidth)

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str:  # noqa: ARG002
        """Add the Gaussians of the standardised observation and their weights to a graph; return
        the output's name.
        """
        y = graph.put(
            "Div", graph.put("Sub", x, self.constants["origin"]), self.constants["spread"]
        )
        rows = self.prepare(theta[None])[0]
        values = gaussians(graph, y, rows[:, :-1].copy(), float(self._bandwidth))
        return graph.put("Mul", values, self.config.weight_scale * rows[:, -1])


def _gaussians(centres: FloatArray, x: FloatArray, bandwidth: float) -> FloatArray:
    """exp(-|c - x|^2 / (2 h^2)) of centres (B, K, d) and observations (B, d), (B, K)."""
    return elementary.exp(gaussian_exponents(centres, x, bandwidth))
