"""Learning algorithms: pure ask and tell on frozen states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import Field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np

from farm.arrays import FloatArray
from learner.algorithms.pgpe import PGPE, PGPEState
from learner.algorithms.state import Diverged, SearchState, StateValue

__all__ = ["PGPE", "Algorithm", "Diverged", "PGPEState", "SearchState"]

State = TypeVar("State", bound=SearchState)


@runtime_checkable
class Algorithm(Protocol[State]):
    """A configuration that learns: a frozen, keyword-only dataclass; everything that changes is in the state.

    Its fields become flags and a table of config.json, so their names must be no other setting's, nor `name`.
    """

    if TYPE_CHECKING:  # `dataclasses.replace` asks for it; at run time a protocol of methods alone can be checked
        __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def signs(self) -> tuple[int, ...]:
        """Rollouts of a row of eps: (1, -1) for mu + eps and mu - eps, (1,) for mu + eps alone."""
        ...

    def init(self, size: int) -> State:
        """Return the state before the first generation, of `size` parameters."""
        ...

    def restore(self, values: Mapping[str, StateValue]) -> State:
        """Return the state that its `to_dict` gave; a ValueError names a wrong key."""
        ...

    def ask(self, state: State, rng: np.random.Generator) -> FloatArray:
        """Draw the perturbations of a generation, (rows, P)."""
        ...

    def tell(self, state: State, eps: FloatArray, returns: FloatArray) -> State:
        """Return the state after one update, from returns (rows, signs); Diverged when it would not be finite."""
        ...
