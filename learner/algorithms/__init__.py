"""Learning algorithms: pure ask and tell on frozen states, by name.

A new one is a module beside `pgpe` and one line in ALGORITHMS. Its configuration is a frozen
dataclass with `init`, `ask`, `tell` and `restore`; everything that changes is in the state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

import numpy as np

from farm.arrays import FloatArray
from learner.algorithms.pgpe import PGPE, PGPEState
from learner.algorithms.pgpe_state import Diverged, StateValue

__all__ = ["ALGORITHMS", "PGPE", "Algorithm", "AlgorithmState", "Diverged", "PGPEState"]


class AlgorithmState(Protocol):
    """What learner, recorder and checkpoint may know of any algorithm's state."""

    @property
    def mu(self) -> FloatArray:
        """Mean of the search distribution, (P,)."""
        ...

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the search distribution, (P,)."""
        ...

    @property
    def best(self) -> float | None:
        """Best return so far, None before the first generation."""
        ...

    @property
    def baseline(self) -> float | None:
        """Return that counts as neither good nor bad, None where there is none."""
        ...

    @property
    def generation(self) -> int:
        """Number of updates done."""
        ...

    def to_dict(self) -> dict[str, StateValue]:
        """Give every field by its name, for a checkpoint."""
        ...


State = TypeVar("State", bound=AlgorithmState)


class Algorithm(Protocol[State]):
    """A configuration that learns; it holds no state of its own."""

    @property
    def pairs(self) -> int:
        """Pairs of rollouts a generation."""
        ...

    @property
    def returns_shape(self) -> tuple[int, int]:
        """Shape of the returns that `tell` takes: (rows of eps, rollouts a row)."""
        ...

    def init(self, size: int) -> State:
        """Return the state before the first generation, of `size` parameters."""
        ...

    def restore(self, values: Mapping[str, StateValue]) -> State:
        """Return the state that its `to_dict` told; ValueError names a wrong key."""
        ...

    def ask(self, state: State, rng: np.random.Generator) -> FloatArray:
        """Draw the perturbations of a generation, (rows, P)."""
        ...

    def tell(self, state: State, eps: FloatArray, returns: FloatArray) -> State:
        """Return the state after one update; Diverged when it would not be finite."""
        ...


ALGORITHMS: dict[str, type[Algorithm[Any]]] = {"pgpe": PGPE}
