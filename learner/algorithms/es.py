"""Evolution strategies as OpenAI uses them (Salimans, Ho, Chen, Sidor & Sutskever 2017,
arXiv:1703.03864).

    s_n ~ N(0, I), n = 1..N;   r(+-,n) = return of mu +- sigma s_n
    u(+-,n) = centred ranks of all 2N returns
    g = 1 / (2 N sigma) sum of (u(+,n) - u(-,n)) s_n  -  lambda mu
    mu += Adam's step along g (Kingma & Ba 2015, algorithm 1, decays 0.9 and 0.999)

sigma never changes. lambda, the weight decay, is part of the gradient, so Adam scales both alike.
The authors' program leaves 1 / sigma out of g, so there the same lambda pulls 1 / sigma times as
hard. Only the order of the returns counts, and equal returns have equal ranks. Shapes: P
parameters, N pairs. Sums run over the pairs in order, never through BLAS.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from farm.arrays import FloatArray
from farm.settings import setting
from learner.algorithms.gradients import adam, centred_ranks, weighted_sum
from learner.algorithms.mirrored import Mirrored
from learner.algorithms.state import SearchState, StateValue

_DECAYS: Final = (0.9, 0.999)


@dataclass(frozen=True, kw_only=True, eq=False)
class ESState(SearchState):
    """The search distribution, and Adam's memory."""

    first_moment: FloatArray
    """Adam's running mean of the gradient, (P,)."""
    second_moment: FloatArray
    """Adam's running mean of the squared gradient, (P,)."""

    def _check_sizes(self) -> None:
        super()._check_sizes()
        for name in ("first_moment", "second_moment"):
            if not getattr(self, name).size:
                raise ValueError(f"state: {name} must have mu's size {self.mu.size}, it is empty")


@dataclass(frozen=True, kw_only=True)
class ES(Mirrored):
    """Evolution strategies with centred ranks, Adam and a constant sigma (Salimans 2017)."""

    pairs: int = setting(20, least=1)
    """Pairs of rollouts per generation, N."""
    learning_rate_mu: float = setting(0.05, least=0.0)
    """Adam's step size."""
    weight_decay: float = setting(0.005, least=0.0)
    """Pull of mu towards 0, lambda: so much of mu is subtracted from its gradient."""
    initial_sigma: float = setting(0.1, above=0.0)
    """Standard deviation of the exploration; it stays constant."""

    def init(self, size: int) -> ESState:
        """Return the state before the first generation, of `size` parameters."""
        still = np.zeros(size)
        return ESState(**vars(super().init(size)), first_moment=still, second_moment=still)

    def restore(self, values: Mapping[str, StateValue]) -> ESState:
        """Return the state from which `to_dict` made these values."""
        return ESState.from_dict(values)

    def scaled(self, sigma: float) -> Self:
        """Return this search at another scale: with this initial sigma, and steps in proportion."""
        rate = self.learning_rate_mu * (sigma / self.initial_sigma)
        return replace(self, initial_sigma=sigma, learning_rate_mu=rate)

    def _step(
        self, state: SearchState, eps: FloatArray, returns: FloatArray
    ) -> dict[str, FloatArray]:
        """The next mu and Adam's memory."""
        assert isinstance(state, ESState)
        ranks = centred_ranks(returns)
        ascent = weighted_sum(ranks[:, 0] - ranks[:, 1], eps / state.sigma) / (
            2 * self.pairs * state.sigma
        )
        step, first, second = adam(
            ascent - self.weight_decay * state.mu,
            (state.first_moment, state.second_moment),
            count=state.generation + 1,
            learning_rate=self.learning_rate_mu,
            decays=_DECAYS,
        )
        return {"mu": state.mu + step, "first_moment": first, "second_moment": second}
