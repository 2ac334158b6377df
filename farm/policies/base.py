"""The base class of policies, which map parameters and observations to actions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from farm.arrays import AnyArray, FloatArray
from farm.errors import ConfigError, UnservedError
from farm.settings import Settings
from farm.tasks.base import TaskSpec


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Settings):
    """Settings of every policy; a policy's own `Config` adds to them.

    Example:
      ```python
      from dataclasses import dataclass

      import farm

      class Wide(farm.Policy):
          @dataclass(frozen=True, kw_only=True)
          class Config(farm.PolicyConfig):
              units: int = farm.setting(32, least=1)
              '''Hidden units; the flag is --units.'''

      assert Wide.Config(normalise=True).units == 32
      ```
    """

    normalise: bool = False
    """Standardise each number of the observation by its mean and spread over all previous
    generations.
    """


class Graph(Protocol):
    """Operators of an ONNX model, one after another."""

    def put(self, operator: str, *values: str | AnyArray | float, **attributes: Any) -> str:  # noqa: ANN401
        """Apply an operator of opset 17 to values by name, or to constants in double precision.

        Returns:
          The name of the result.
        """
        ...


class Policy:
    """A deterministic controller for batches of B parameter vectors and observations.

    A row's action must not depend on the other rows of its batch. So write sums out or compute them
    row by row: in a matrix product over a batch the order of sums depends on the batch's size.

    Example:
      ```python
      import numpy as np

      import farm

      class Linear(farm.Policy):
          '''a = K x, with d parameters per action.'''

          @property
          def size(self):
              return self.spec.action * self.spec.observation

          def prepare(self, theta):  # (B, P) -> (B, A, d)
              return theta.reshape(len(theta), self.spec.action, -1)

          def act(self, prepared, x):  # (B, A, d), (B, d) -> (B, A)
              return (prepared * x[:, None, :]).sum(axis=-1)

      spec = farm.TaskSpec(observation=3, action=2, steps=10, period=0.1)
      policy = Linear(farm.PolicyConfig(), spec, {})
      prepared = policy.prepare(np.ones((5, policy.size)))
      assert policy.act(prepared, np.ones((5, 3))).tolist() == [[3.0, 3.0]] * 5
      ```
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    """The policy's settings: its fields define flags, help and config.json."""
    standardised: ClassVar[bool] = False
    """Whether the policy's constants include `origin` and `spread` (d,) of the task's observation,
    measured as a run begins.
    """

    def __init__(
        self, config: PolicyConfig, spec: TaskSpec, constants: Mapping[str, FloatArray]
    ) -> None:
        """Take the settings, the task's sizes, and the constants from `draw`."""
        self.config: Any = config
        self.spec = spec
        self.constants = constants

    @classmethod
    def draw(
        cls,
        config: PolicyConfig,  # noqa: ARG003
        spec: TaskSpec,  # noqa: ARG003
        rng: np.random.Generator,  # noqa: ARG003
    ) -> dict[str, FloatArray]:
        """Constants of a run, by name: drawn once, then stored and sent with the run."""
        return {}

    @property
    def size(self) -> int:
        """Length P of a parameter vector."""
        raise NotImplementedError

    def start(self, rng: np.random.Generator) -> FloatArray | None:  # noqa: ARG002
        """Where the search starts, (P,): added to the algorithm's initial mean; None: zeros.

        It is drawn anew from the run's seed whenever it is needed, only on the learner.
        """
        return None

    @property
    def scale(self) -> FloatArray | None:
        """Change of each parameter if the search changes it by 1, (P,), positive; None: 1.

        The search works on z, theta = scale z. So its perturbations, its steps and its floors of
        parameter i are those of the algorithm times scale_i, whichever algorithm it is: with one
        step size for all parameters (cma-es), with steps of a length of their own (Adam, ClipUp).
        Whatever a search handles is in units of z: mu, sigma, eps, parameters of `farm.Farm`.
        `start` and `prepare` have theta.
        """
        return None

    @property
    def memory(self) -> FloatArray | None:
        """Memory of a rollout at its start, (m,); None: the policy has none.

        The action of a policy with memory depends on the observations before, too. Its `act` takes
        the memories of the rollouts, (B, m), as a third argument, and returns a pair: the actions
        (B, A), and the next memories (B, m).
        """
        return None

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Compute from parameters (B, P) what is constant during a rollout, (B, ...)."""
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions.

        Args:
          prepared: (B, ...) from `prepare`.
          x: (B, d) observations.

        Returns:
          (B, A), of any magnitude; the task defines their meaning.
        """
        raise NotImplementedError

    def onnx(self, graph: Graph, theta: FloatArray, x: str, memory: str) -> str | tuple[str, str]:
        """Put into a graph what `act` computes, for `farm export`, which compares both.

        Args:
          graph: `graph.put("MatMul", x, weights)` is the name of a product.
          theta: the parameters (P,), as for `prepare`.
          x: name of the observations, (N, d).
          memory: name of the memories, (N, m).

        Returns:
          The name of the actions, (N, A); with memory a pair of it and the name of the next
          memories, (N, m).
        """
        raise NotImplementedError


def check_constants(
    constants: Mapping[str, FloatArray], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Check that a run's constants have these shapes.

    Raises:
      UnservedError: one is missing or has a different shape.
    """
    for name, shape in shapes.items():
        if name not in constants or constants[name].shape != shape:
            shape_here = constants[name].shape if name in constants else "missing"
            raise UnservedError(
                f"constant {name!r} of the policy is {shape_here}; expected an array of shape"
                f" {shape}"
            )


def check_vector(name: str, values: Any, size: int | None = None) -> None:  # noqa: ANN401  what a policy gave
    """Check that values are None or a vector of finite numbers: (size,), or of any length.

    Raises:
      ConfigError: they are something else.
    """
    if values is None:
        return
    array = isinstance(values, np.ndarray)
    vector = array and values.dtype == np.float64 and values.ndim == 1 and np.isfinite(values).all()
    if vector and size in (None, len(values)):
        return
    got = f"an array of {values.dtype} {values.shape}" if array else f"a {type(values).__name__}"
    count = "a vector of" if size is None else size
    raise ConfigError(f"{name} gave {got}; expected {count} finite numbers of float64, or None")
