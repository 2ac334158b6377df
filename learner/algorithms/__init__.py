"""Learning algorithms: pure functions `ask` and `tell` on immutable states."""

from collections.abc import Mapping
from dataclasses import Field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, runtime_checkable

import numpy as np

from farm.arrays import FloatArray
from farm.errors import TaskError
from farm.returns import known
from learner.algorithms.pgpe import PGPE, PGPEState
from learner.algorithms.state import Diverged, SearchState, StateValue

__all__ = ["PGPE", "Algorithm", "Diverged", "PGPEState", "SearchState"]

State = TypeVar("State", bound=SearchState)


@runtime_checkable
class Algorithm(Protocol[State]):
    """An algorithm and its settings: a frozen, keyword-only dataclass; everything that changes is
    in the state.

    Its fields become flags and a table of config.json, so no other setting may have their names;
    `name` is reserved.

    Example:
      ```python
      import numpy as np

      import farm

      algorithm, rng = farm.configure("finger-gait").algorithm_config, np.random.default_rng(0)
      state = algorithm.init(5)  # P parameters
      for _ in range(30):
          eps = algorithm.ask(state, rng)  # (rows, P)
          candidates = [state.mu + sign * eps for sign in algorithm.signs()]
          errors = [((each - 1.0) ** 2).sum(axis=1) for each in candidates]
          returns = -np.stack(errors, axis=1)  # (rows, signs)
          state = algorithm.tell(state, eps, returns)
      assert state.generation == 30
      assert ((state.mu - 1.0) ** 2).sum() < 1.0  # it began with 5
      ```
    """

    # `dataclasses.replace` needs it; isinstance works only for protocols of methods alone
    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def signs(self) -> tuple[int, ...]:
        """Signs of eps in the rollouts of a row: (1, -1) for mu + eps and mu - eps, (1,) for mu +
        eps alone.
        """

    def init(self, size: int) -> State:
        """Return the state before the first generation, of `size` parameters."""

    def restore(self, values: Mapping[str, StateValue]) -> State:
        """Return the state from which `to_dict` made these values; a ValueError names a wrong
        key.
        """

    def ask(self, state: State, rng: np.random.Generator) -> FloatArray:
        """Draw the perturbations of a generation, (rows, P)."""

    def tell(self, state: State, eps: FloatArray, returns: FloatArray) -> State:
        """Return the state after one update, from returns (rows, signs).

        Raises Diverged if it would not be finite.
        """


def begin(algorithm: Algorithm[Any], size: int, start: FloatArray | None = None) -> SearchState:
    """The algorithm's state before the first generation, of `size` parameters, with `start` (P,)
    added to its mean.

    Raises:
      TaskError: it, or the algorithm's signs, are invalid.
    """
    signs: object = algorithm.signs()
    if not isinstance(signs, tuple) or signs not in ((1,), (1, -1)):
        raise TaskError(
            f"signs of {type(algorithm).__name__} gave {signs!r}; expected (1,) or (1, -1)"
        )
    state = _checked(algorithm, "init", algorithm.init(size), size, 0)
    return state if start is None else replace(state, mu=state.mu + start)


def ask(algorithm: Algorithm[Any], state: SearchState, rng: np.random.Generator) -> FloatArray:
    """The perturbations of a generation, (rows, P).

    Raises:
      TaskError: they have another shape, or are not finite.
    """
    eps = algorithm.ask(state, rng)
    if (
        not isinstance(eps, np.ndarray)
        or eps.dtype.kind != "f"
        or eps.shape[1:] != state.mu.shape
        or not len(eps)
    ):
        got = (
            f"an array of {eps.dtype} {eps.shape}"
            if isinstance(eps, np.ndarray)
            else f"a {type(eps).__name__}"
        )
        expected = f"expected numbers of shape (rows, {state.mu.size})"
        raise TaskError(f"ask of {type(algorithm).__name__} gave {got}; {expected}")
    if not np.isfinite(eps).all():
        raise TaskError(
            f"ask of {type(algorithm).__name__} is not finite in generation {state.generation}"
        )
    return np.ascontiguousarray(eps, dtype=np.float64)


def tell(
    algorithm: Algorithm[Any], state: SearchState, eps: FloatArray, returns: FloatArray
) -> SearchState:
    """The state after one update, from returns (rows, signs).

    Only counted if no rollout has a return.

    Raises:
      TaskError: it is invalid; Diverged: it would not be finite.
    """
    if not known(returns).any():
        return replace(state, generation=state.generation + 1)
    after = algorithm.tell(state, eps, returns)
    return _checked(algorithm, "tell", after, state.mu.size, state.generation + 1)


def _checked(
    algorithm: Algorithm[Any], method: str, state: object, size: int, generation: int
) -> SearchState:
    where = f"{method} of {type(algorithm).__name__} gave"
    if not isinstance(state, SearchState):
        raise TaskError(f"{where} a {type(state).__name__}; expected a farm.SearchState")
    if (state.mu.size, state.generation) != (size, generation):
        got = f"{state.mu.size} parameters in generation {state.generation}"
        raise TaskError(f"{where} a state of {got}; expected {size} in generation {generation}")
    return state
