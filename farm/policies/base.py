"""The base class of policies, which map parameters and observations to actions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from farm.arrays import FloatArray
from farm.errors import UnservedError
from farm.settings import Settings
from farm.tasks.base import TaskSpec


@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Settings):
    """Settings that every policy has; a policy's own `Config` adds to them."""

    normalise: bool = False
    """Standardise each number of the observation by its mean and spread over all generations before."""


class Policy:
    """A deterministic controller for batches of B parameter vectors and observations.

    A row's action must not depend on the other rows of its batch: spell sums out or run them row by row, because a
    matrix product over a batch orders its sums by its shape.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    """The policy's own settings: flags, help and config.json follow from its fields."""
    standardised: ClassVar[bool] = False
    """Whether its constants have `origin` and `spread` (d,) of the task's observation, measured as a run begins."""

    def __init__(self, config: PolicyConfig, spec: TaskSpec, constants: Mapping[str, FloatArray]) -> None:
        """Take the settings, the task's sizes, and what `draw` gave."""
        self.config: Any = config
        self.spec = spec
        self.constants = constants

    @classmethod
    def draw(cls, config: PolicyConfig, spec: TaskSpec, rng: np.random.Generator) -> dict[str, FloatArray]:  # noqa: ARG003
        """Constants of a run, by name: drawn once, then stored and sent with the run."""
        return {}

    @property
    def size(self) -> int:
        """Length P of a parameter vector."""
        raise NotImplementedError

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Compute what does not change during a rollout from parameters (B, P); (B, ...)."""
        return theta

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions.

        Args:
          prepared: (B, ...) from `prepare`.
          x: (B, d) observations.

        Returns:
          (B, A), of any size; the task says what they mean.
        """
        raise NotImplementedError


def check_constants(constants: Mapping[str, FloatArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check that a run's constants fit its task.

    Raises:
      UnservedError: one is missing or has another shape.
    """
    for name, shape in shapes.items():
        if name not in constants or constants[name].shape != shape:
            found = constants[name].shape if name in constants else "missing"
            raise UnservedError(f"constant {name!r} of the policy is {found}; expected an array of shape {shape}")
