"""Controllers with random Fourier features (thesis 3.2 and 3.5.4), and the kernel they approximate.

Pure, batched.

One action a_i for each of A controlled joints or actuators:

    direct     a_i = theta_i . z(x)                      D parameters per action (thesis 3.7)
    projected  a_i = z(theta_i) . z(x)                   d parameters per action (thesis 3.8)
    kernel     a_i = exp(-|theta_i - x|^2 / (2 h^2))     d parameters per action: the limit
                                                         D -> infinity of `projected`
    cosine     a_i = cos(theta_i) . z(x)                 D bounded parameters per action
                                                         (thesis 5.2, future work)

    z(x) = sqrt(2/D) cos(W x / h + c),  W ~ N(0, 1) of (D, d), c ~ U[0, 2 pi] of (D,)
           (Rahimi & Recht 2007)

Numpy's exp and cos depend on the processor. So the kernel uses the C library's exp, and the
features the cosines of `farm/elementary.py`: in single precision the cheaper one of turns, for
which W / h and c are divided by 2 pi.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np

from farm import elementary
from farm.arrays import AnyArray, FloatArray
from farm.policies.base import Graph, Policy, PolicyConfig, check_constants
from farm.settings import setting
from farm.tasks.base import TaskSpec

_CACHED: Final = 8192  # numbers


@dataclass(frozen=True, kw_only=True)
class KernelConfig(PolicyConfig):
    """Settings of the kernel controller."""

    bandwidth: float = setting(1.0, above=0.0)
    """Width h of the Gaussian kernel, in units of the observation."""


@dataclass(frozen=True, kw_only=True)
class FeaturesConfig(KernelConfig):
    """Settings of controllers with random features."""

    features: int = setting(8000, least=1, most=10_000_000)
    """Number of random Fourier features, D."""
    precision: Literal["double", "single"] = "double"
    """Number format of the features: single takes half the time and changes actions by about 1e-6.
    """


class Kernel(Policy):
    """Gaussian kernel between parameters and observation: a_i = exp(-|theta_i - x|^2 / (2 h^2))."""

    Config: ClassVar[type[PolicyConfig]] = KernelConfig

    @property
    def size(self) -> int:
        """A times d."""
        return self.spec.action * self.spec.observation

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Centres of the kernels, (B, A, d)."""
        return _by_action(theta, self.spec.action)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions in (0, 1]."""
        exponents = gaussian_exponents(prepared, x, self.config.bandwidth)
        # Number by number: a step has only a few, for which the numpy calls of `elementary.exp`
        # would take longer.
        return np.fromiter(
            map(math.exp, exponents.ravel().tolist()), float, exponents.size
        ).reshape(exponents.shape)

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str:  # noqa: ARG002
        """Add the Gaussians to a graph; return the output's name."""
        return gaussians(graph, x, self.prepare(theta[None])[0], self.config.bandwidth)


class Direct(Policy):
    """Weights of random features: a_i = theta_i . z(x) (thesis 3.7)."""

    Config: ClassVar[type[PolicyConfig]] = FeaturesConfig

    def __init__(
        self, config: PolicyConfig, spec: TaskSpec, constants: Mapping[str, FloatArray]
    ) -> None:
        """Keep the feature map ready to use."""
        super().__init__(config, spec, constants)
        count = self.config.features
        check_constants(constants, {"frequencies": (count, spec.observation), "phases": (count,)})
        single = self.config.precision == "single"
        self._cos, unit = (elementary.cos_turns, 2.0 * math.pi) if single else (elementary.cos, 1.0)
        self._dtype = np.dtype("<f4" if single else "<f8")
        # One contiguous row per number of x: W x is then d multiply-adds of (D,) vectors, in order.
        rows = np.ascontiguousarray((constants["frequencies"] / self.config.bandwidth).T)
        arrays = rows / unit, constants["phases"] / unit, np.sqrt(2.0 / count)
        self._rows, self._phases, self._scale = (
            np.asarray(values, dtype=self._dtype) for values in arrays
        )
        # Observations, whose features stay in a core's cache
        self._together = max(1, _CACHED // count)

    @classmethod
    def draw(
        cls, config: PolicyConfig, spec: TaskSpec, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """Frequencies W (D, d) and phases c (D,)."""
        assert isinstance(config, FeaturesConfig)
        frequencies = rng.standard_normal((config.features, spec.observation))
        return {
            "frequencies": frequencies,
            "phases": rng.uniform(0.0, 2.0 * np.pi, config.features),
        }

    @property
    def size(self) -> int:
        """A times D."""
        return self.spec.action * len(self.constants["phases"])

    def prepare(self, theta: FloatArray) -> AnyArray:
        """Weights of the features, (B, A, D), in their precision."""
        return self._rounded(_by_action(theta, self.spec.action))

    def act(self, prepared: AnyArray, x: FloatArray) -> FloatArray:
        """Actions; may be huge or not finite."""
        out = np.empty(prepared.shape[:2])
        with np.errstate(over="ignore", invalid="ignore"):
            for first in range(0, len(x), self._together):
                rows = slice(first, first + self._together)
                # A different memory order would change the rounding of sums.
                out[rows] = np.multiply(
                    prepared[rows], self.features(x[rows])[:, None, :], order="C"
                ).sum(axis=-1)
        return out

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str:  # noqa: ARG002
        """Add the features and their weights to a graph, in double precision even if the policy
        works in single; return the output's name.
        """
        rows = (self.constants["frequencies"] / self.config.bandwidth).T.copy()
        phases = self.constants["phases"]
        features = graph.put("Cos", graph.put("Add", graph.put("MatMul", x, rows), phases))
        weights = self.prepare(theta[None])[0].astype(float)
        return graph.put("MatMul", features, np.sqrt(2.0 / len(phases)) * weights.T)

    def features(self, x: FloatArray) -> AnyArray:
        """z(x) of observations, (n, d) -> (n, D), in their precision."""
        angle = np.empty((len(x), len(self._phases)), self._dtype)
        angle[:] = self._phases
        product = np.empty_like(angle)
        for row, values in zip(self._rows, self._rounded(x).T, strict=True):
            np.multiply(row, values[:, None], out=product)
            angle += product
        return self._scale * self._cos(angle)

    def _rounded(self, values: FloatArray) -> AnyArray:
        with np.errstate(over="ignore"):
            return values.astype(self._dtype, copy=False)


class Projected(Direct):
    """The kernel, approximated by random features: a_i = z(theta_i) . z(x) (thesis 3.8)."""

    @property
    def size(self) -> int:
        """A times d."""
        return self.spec.action * self.spec.observation

    def prepare(self, theta: FloatArray) -> AnyArray:
        """Features of the parameters, (B, A, D), in their precision."""
        with np.errstate(over="ignore", invalid="ignore"):
            joints = _by_action(theta, self.spec.action)
            return np.stack([self.features(rollout) for rollout in joints])


class Cosine(Direct):
    """Bounded weights of random features: a_i = cos(theta_i) . z(x) (thesis 5.2)."""

    def prepare(self, theta: FloatArray) -> AnyArray:
        """Weights of the features, (B, A, D), in their precision."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._rounded(elementary.cos(_by_action(theta, self.spec.action)))


def gaussian_exponents(centres: FloatArray, x: FloatArray, bandwidth: float) -> FloatArray:
    """-|c - x|^2 / (2 h^2) of centres (B, K, d) and observations (B, d), (B, K)."""
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.ascontiguousarray(centres) - np.ascontiguousarray(x)[:, None, :]
        squares = (difference * difference).sum(axis=-1)
    return squares * (-0.5 / bandwidth**2)


def gaussians(graph: Graph, x: str, centres: FloatArray, bandwidth: float) -> str:
    """Name of exp(-|c - x|^2 / (2 h^2)) of centres (K, d) in a graph, (N, K)."""
    difference = graph.put("Sub", graph.put("Unsqueeze", x, np.array([1])), centres)
    squares = graph.put(
        "ReduceSum", graph.put("Mul", difference, difference), np.array([2]), keepdims=0
    )
    return graph.put("Exp", graph.put("Mul", squares, -0.5 / bandwidth**2))


def _by_action(theta: FloatArray, actions: int) -> FloatArray:
    return np.ascontiguousarray(theta).reshape(len(theta), actions, -1)
