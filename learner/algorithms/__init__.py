"""Learning algorithms: pure functions `ask` and `tell` on immutable states."""

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
    """An algorithm and its settings: a frozen, keyword-only dataclass; everything that changes is in the state.

    Its fields become flags and a table of config.json, so no other setting may have their names; `name` is reserved.
    """

    if TYPE_CHECKING:  # `dataclasses.replace` needs it; isinstance works only for protocols of methods alone
        __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def signs(self) -> tuple[int, ...]:
        """Signs of eps in the rollouts of a row: (1, -1) for mu + eps and mu - eps, (1,) for mu + eps alone."""

    def init(self, size: int) -> State:
        """Return the state before the first generation, of `size` parameters."""

    def restore(self, values: Mapping[str, StateValue]) -> State:
        """Return the state from which `to_dict` made these values; a ValueError names a wrong key."""

    def ask(self, state: State, rng: np.random.Generator) -> FloatArray:
        """Draw the perturbations of a generation, (rows, P)."""

    def tell(self, state: State, eps: FloatArray, returns: FloatArray) -> State:
        """Return the state after one update, from returns (rows, signs); raises Diverged if it would not be finite."""
