"""SNES, separable natural evolution strategies, with mirrored samples.

Wierstra, Schaul, Glasmachers, Sun, Peters & Schmidhuber 2014, Natural evolution strategies,
algorithm 6.

    s_k ~ N(0, I),  theta_k = mu + sigma s_k,  k = 1..2N: pairs s and -s
    u_k = max(0, ln(N + 1) - ln(rank of k)) / sum of these - 1 / 2N
          (rank 1 is the best; ties get their mean u)
    mu    += eta_mu sigma sum_k u_k s_k
    sigma *= exp(eta_sigma / 2 sum_k u_k (s_k^2 - 1))
    eta_mu = 1,  eta_sigma = (3 + ln P) / (5 sqrt(P))

Only the order of the returns counts. Shapes: P parameters, N pairs. Sums run over the pairs in
order, never through BLAS.
"""

import math
from dataclasses import dataclass

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.settings import setting
from learner.algorithms.gradients import weighted_sum
from learner.algorithms.mirrored import Mirrored
from learner.algorithms.state import SearchState


@dataclass(frozen=True, kw_only=True)
class SNES(Mirrored):
    """Separable natural evolution strategies, with mirrored samples and utilities by rank (Wierstra
    2014).
    """

    pairs: int = setting(10, least=1)
    """Pairs of rollouts per generation, N."""
    learning_rate_mu: float = setting(1.0, least=0.0)
    """Step size of mu, eta_mu."""
    learning_rate_sigma: float | None = setting(None, least=0.0)
    """Step size of sigma, eta_sigma; by default (3 + ln P) / (5 sqrt(P)) with P parameters."""
    sigma_floor: float = setting(1e-6, above=0.0)
    """Smallest standard deviation, in units of the parameters."""

    def _step(
        self, state: SearchState, eps: FloatArray, returns: FloatArray
    ) -> dict[str, FloatArray]:
        """The next mu and sigma."""
        size, u, rate = state.mu.size, utilities(returns), self.learning_rate_sigma
        rate = (3.0 + math.log(size)) / (5.0 * math.sqrt(size)) if rate is None else rate
        s = eps / state.sigma
        to_mu = weighted_sum(u[:, 0] - u[:, 1], s)
        to_sigma = weighted_sum(u[:, 0] + u[:, 1], s * s - 1.0)
        mu = state.mu + self.learning_rate_mu * state.sigma * to_mu
        sigma = state.sigma * elementary.exp(0.5 * rate * to_sigma)
        return {"mu": mu, "sigma": np.maximum(sigma, self.sigma_floor)}


def utilities(returns: FloatArray) -> FloatArray:
    """Weights of returns by rank, any shape.

    They add up to 0, and equal returns have equal weights.
    """
    flat = returns.ravel()
    count = flat.size
    logs = [max(0.0, math.log(count / 2.0 + 1.0) - math.log(rank)) for rank in range(1, count + 1)]
    by_rank = np.array(logs) / math.fsum(logs) - 1.0 / count
    # The best comes first
    _, group, sizes = np.unique(-flat, return_inverse=True, return_counts=True)
    ends = np.cumsum(sizes)
    shared = np.array(
        [math.fsum(by_rank[end - n : end]) / n for end, n in zip(ends, sizes, strict=True)]
    )
    return shared[group.ravel()].reshape(returns.shape)
