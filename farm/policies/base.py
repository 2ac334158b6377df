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
    """Settings of every policy; a policy's own `Config` adds to them."""

    normalise: bool = False
    """Standardise each number of the observation by its mean and spread over all previous generations."""


class Policy:
    """A deterministic controller for batches of B parameter vectors and observations.

    A row's action must not depend on the other rows of its batch. So write sums out or compute them row by row: in a
    matrix product over a batch the order of sums depends on the batch's size.
    """

    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    """The policy's settings: its fields define flags, help and config.json."""
    standardised: ClassVar[bool] = False
    """Whether its constants include `origin` and `spread` (d,) of the task's observation, measured as a run begins."""

    def __init__(self, config: PolicyConfig, spec: TaskSpec, constants: Mapping[str, FloatArray]) -> None:
        """Take the settings, the task's sizes, and the constants from `draw`."""
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


def check_constants(constants: Mapping[str, FloatArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Check that a run's constants have these shapes.

    Raises:
      UnservedError: one is missing or has a different shape.
    """
    for name, shape in shapes.items():
        if name not in constants or constants[name].shape != shape:
            found = constants[name].shape if name in constants else "missing"
            raise UnservedError(f"constant {name!r} of the policy is {found}; expected an array of shape {shape}")
