"""Base class of algorithms with mirrored samples: N pairs mu + eps and mu - eps, eps ~ N(0,
diag(sigma^2)).

Shapes: P parameters, N pairs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from farm.arrays import FloatArray
from farm.settings import Settings, setting
from learner.algorithms.state import SearchState, StateValue, comparable, finite_rows, moved


@dataclass(frozen=True, kw_only=True)
class Mirrored(Settings):
    """Settings and methods; subclasses add `_step`."""

    pairs: int = setting(16, least=1)
    """Pairs of rollouts per generation, N."""
    initial_mu: float = 0.0
    """First mean of every parameter."""
    initial_sigma: float = setting(1.0, above=0.0)
    """First standard deviation of every parameter."""

    def scaled(self, sigma: float) -> Self:
        """Return this search at another scale: with this initial sigma, and steps in proportion."""
        return replace(self, initial_sigma=sigma)

    def signs(self) -> tuple[int, ...]:
        """Rollouts of a row of eps: mu + eps and mu - eps."""
        return (1, -1)

    def init(self, size: int) -> SearchState:
        """Return the state before the first generation, of `size` parameters."""
        return SearchState(
            mu=np.full(size, float(self.initial_mu)), sigma=np.full(size, float(self.initial_sigma))
        )

    def restore(self, values: Mapping[str, StateValue]) -> SearchState:
        """Return the state from which `to_dict` made these values."""
        return SearchState.from_dict(values)

    def ask(self, state: SearchState, rng: np.random.Generator) -> FloatArray:
        """Draw eps, (N, P)."""
        return state.sigma * rng.standard_normal((self.pairs, state.mu.size))

    def tell(self, state: SearchState, eps: FloatArray, returns: FloatArray) -> SearchState:
        """Return the state after one update.

        Args:
          state: the state `eps` was drawn from.
          eps: from `ask`, (N, P).
          returns: (N, 2), columns (+, -); all finite.

        Raises:
          ValueError: a shape is wrong, or a value not finite.
          Diverged: the update would not be finite.
        """
        eps = finite_rows("eps", eps, (self.pairs, state.mu.size))
        returns = comparable(returns, (self.pairs, 2))
        with np.errstate(all="ignore"):
            return moved(state, returns, **self._step(state, eps, returns))

    def _step(
        self, state: SearchState, eps: FloatArray, returns: FloatArray
    ) -> dict[str, FloatArray]:
        """The arrays that an update changes, by name; for arguments see `tell`."""
        raise NotImplementedError
