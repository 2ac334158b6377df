"""ARS, augmented random search (Mania, Guy & Recht 2018, Simple random search provides a
competitive approach to RL).

    delta_n ~ N(0, I), n = 1..N;   r(+-,n) = return of mu +- nu delta_n
    mu += alpha / (b sigma_R) sum of (r(+,n) - r(-,n)) delta_n,
          over the b directions of the largest max(r(+,n), r(-,n))

sigma_R is the standard deviation of these 2b returns. nu, here the state's sigma, never changes.
With `--normalise` this is the paper's V2-t, otherwise V1-t. Shapes: P parameters, N pairs. Sums run
over the directions in order, never through BLAS.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.settings import setting
from learner.algorithms.gradients import weighted_sum
from learner.algorithms.mirrored import Mirrored
from learner.algorithms.state import SearchState


@dataclass(frozen=True, kw_only=True)
class ARS(Mirrored):
    """Augmented random search: steps along the best random directions (Mania 2018)."""

    pairs: int = setting(16, least=1)
    """Directions per generation, N; each is a pair of rollouts."""
    top: int | None = setting(None, least=1)
    """Number of directions that are used, b; by default half of them, rounded up."""
    learning_rate_mu: float = setting(0.02, least=0.0)
    """Step size, alpha."""
    initial_sigma: float = setting(0.03, above=0.0)
    """Standard deviation of the exploration, nu; it stays constant."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.top is not None and self.top > self.pairs:
            raise ConfigError(f"top is {self.top}; expected 1 to {self.pairs} (pairs)")

    def scaled(self, sigma: float) -> Self:
        """Return this search at another scale: with this initial sigma, and steps in proportion."""
        rate = self.learning_rate_mu * (sigma / self.initial_sigma)
        return replace(self, initial_sigma=sigma, learning_rate_mu=rate)

    def _step(
        self, state: SearchState, eps: FloatArray, returns: FloatArray
    ) -> dict[str, FloatArray]:
        """The next mu; if all used returns are equal, it does not move."""
        top = self.top or -(-self.pairs // 2)
        rows = np.sort(np.argsort(-returns.max(axis=1), kind="stable")[:top])
        spread = float(returns[rows].std())
        contrast = returns[rows, 0] - returns[rows, 1]
        step = weighted_sum(contrast, eps[rows] / state.sigma)
        rate = self.learning_rate_mu / (top * spread) if spread > 0.0 else 0.0
        return {"mu": state.mu + rate * step}
