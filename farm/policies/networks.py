"""Linear and neural network controllers, and a constant action for comparison. Pure, batched.

    constant  a = b
    linear    a = W x + b; with --no-bias a = W x (ARS's own: Mania, Guy & Recht 2018)
    mlp       h_1 = tanh(W_1 x + b_1), ..., h_L = tanh(W_L h_(L-1) + b_L), a = W h_L + b
              (Rumelhart, Hinton & Williams 1986, Learning representations by back-propagating
              errors)

Parameters are the layers one after another, each with one row (W_i, b_i) per unit. A unit's sum
runs over its own row, in an order that depends only on the row's length; tanh is that of
`farm/elementary.py`. So no result depends on the batch.

The search of an mlp starts at random weights of variance 1/inputs (LeCun, Bottou, Orr & Müller
1998, Efficient BackProp), those of the output ten times as small, and biases 0. At zero all
derivatives by the weights vanish.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Final

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.policies.base import Graph, Policy, PolicyConfig

_LAYERS: Final = 20
_UNITS: Final = 10_000  # of a layer
# Scale of the output's weights at the start: little action, so that nothing saturates
_OUTPUT: Final = 0.1


@dataclass(frozen=True, kw_only=True)
class LinearConfig(PolicyConfig):
    """Settings of the linear policy."""

    bias: bool = True
    """Whether an action has a constant part, b."""


@dataclass(frozen=True, kw_only=True)
class MlpConfig(PolicyConfig):
    """Settings of the multilayer perceptron."""

    layers: tuple[int, ...] = (32, 32)
    """Units of each hidden layer, first to last; repeat the flag for each layer."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.layers) <= _LAYERS:
            raise ConfigError(
                f"layers are {len(self.layers)}; expected 1 to {_LAYERS} hidden layers"
            )
        for units in self.layers:
            if type(units) is not int or not 1 <= units <= _UNITS:
                raise ConfigError(f"layers has {units!r}; expected 1 to {_UNITS} units in each")


class Linear(Policy):
    """Affine map of the observation: a = W x + b."""

    Config: ClassVar[type[PolicyConfig]] = LinearConfig

    @property
    def size(self) -> int:
        """A (d + 1), without bias A d."""
        return sum(units * (inputs + self._bias) for inputs, units in pairwise(self._sizes))

    @property
    def _bias(self) -> bool:
        """Whether the units have a bias."""
        return getattr(self.config, "bias", True)

    @property
    def _sizes(self) -> tuple[int, ...]:
        """Number of inputs of each layer, and of outputs of the last."""
        return self.spec.observation, self.spec.action

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions; may be huge or not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            out, layers = x, len(self._sizes) - 1
            for layer, (weights, bias) in enumerate(self._matrices(prepared), 1):
                out = affine(weights, bias, out)
                if layer < layers:
                    out = elementary.tanh(out)
        return out

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str | tuple[str, str]:  # noqa: ARG002
        """Add the layers to a graph; return the output's name."""
        return self._layers(graph, theta, x)[-1]

    def _layers(self, graph: Graph, theta: FloatArray, x: str) -> list[str]:
        """Add the layers to a graph; return the name of each one's output, before the next tanh."""
        out: list[str] = []
        for weights, bias in self._matrices(theta[None]):
            x = graph.put("MatMul", graph.put("Tanh", x) if out else x, weights[0].T.copy())
            x = x if bias is None else graph.put("Add", x, bias[0])
            out.append(x)
        return out

    def _matrices(self, theta: FloatArray) -> Iterator[tuple[FloatArray, FloatArray | None]]:
        """Weights (B, units, inputs) and biases (B, units) or None of each layer, from parameters
        (B, P).
        """
        first = 0
        for inputs, units in pairwise(self._sizes):
            end = first + units * (inputs + self._bias)
            rows = theta[:, first:end].reshape(len(theta), units, inputs + self._bias)
            yield rows[:, :, :inputs], rows[:, :, -1] if self._bias else None
            first = end


class Constant(Linear):
    """One action for every observation: a baseline that a controller with feedback should
    beat.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig

    @property
    def _sizes(self) -> tuple[int, ...]:
        return 0, self.spec.action

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions: the parameters."""
        return super().act(prepared, x[:, :0])

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str:  # noqa: ARG002
        """Add the parameters to a graph, once for each observation; return the output's name."""
        return graph.put(
            "Add",
            graph.put("MatMul", x, np.zeros((self.spec.observation, self.spec.action))),
            theta,
        )


class Mlp(Linear):
    """Multilayer perceptron with tanh units and a linear output."""

    Config: ClassVar[type[PolicyConfig]] = MlpConfig

    @property
    def _sizes(self) -> tuple[int, ...]:
        return self.spec.observation, *self.config.layers, self.spec.action

    def start(self, rng: np.random.Generator) -> FloatArray:
        """Random weights, so that the units of a layer differ; biases 0."""
        layers = []
        for inputs, units in pairwise(self._sizes):
            layer = np.zeros((units, inputs + 1))
            layer[:, :-1] = rng.standard_normal((units, inputs)) / np.sqrt(inputs)
            layers.append(layer)
        layers[-1] *= _OUTPUT
        return np.concatenate([layer.ravel() for layer in layers])


def affine(weights: FloatArray, bias: FloatArray | None, x: FloatArray) -> FloatArray:
    """W x + b of weights (B, units, inputs), biases (B, units) or None, and x (B, inputs), (B,
    units).
    """
    # A different memory order would change the rounding of sums.
    out: FloatArray = np.multiply(weights, x[:, None, :], order="C").sum(axis=-1)
    return out if bias is None else out + bias
