"""PGPE, policy gradients with parameter-based exploration, as `ask` and `tell` on an immutable
state.

Rollouts of theta = mu + eps and mu - eps are compared, and mu and sigma follow the better one
(Sehnke 2010; Plage 2016, algorithm 1). The defaults are the paper's rule as the thesis states it;
ranks with ClipUp (Toklu 2020) or Adam are the modern variant. Shapes: P parameters, N pairs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.settings import Settings, setting
from learner.algorithms.gradients import (
    Normaliser,
    SigmaRule,
    adam,
    baseline_contrast,
    centred_ranks,
    clipup,
    level,
    middle_returns,
    optimal_baseline,
    pair_contrast,
    plain_contrast,
    sigma_characteristic,
    signed_ranks,
    step_sigma,
    weighted_sum,
)
from learner.algorithms.state import Diverged, SearchState, StateValue, comparable, finite_rows

# The authors' code: b = 0.9 b + 0.1 mean return.
_BASELINE_MEMORY = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class PGPEState(SearchState):
    """The search distribution, and the memory of the optimiser of mu."""

    velocity: FloatArray = field(default_factory=lambda: np.empty(0))
    """ClipUp's velocity, (P,), or empty if it is not used."""
    first_moment: FloatArray = field(default_factory=lambda: np.empty(0))
    """Adam's running mean of the gradient, (P,), or empty."""
    second_moment: FloatArray = field(default_factory=lambda: np.empty(0))
    """Adam's running mean of the squared gradient, (P,), or empty."""


@dataclass(frozen=True, kw_only=True)
class PGPE(Settings):
    """Policy gradients with parameter-based exploration: rollouts of mu + eps and mu - eps (Sehnke
    2010).
    """

    pairs: int = setting(15, least=1)
    """Pairs of rollouts per generation, N: 2N rollouts with either estimator."""
    estimator: Literal["symmetric", "plain"] = "symmetric"
    """Pairs mu + eps and mu - eps, or 2N single rollouts mu + eps (Plage 2016, eq. 3.1)."""
    normaliser: Normaliser = "sehnke"
    """Scale of raw returns: by the distance to the best return, or as the thesis prints it."""
    baseline: Literal["moving-average", "optimal", "none"] = "moving-average"
    """Return that counts as neither good nor bad: 0.9 b + 0.1 mean, least variance, or 0."""
    sigma_rule: SigmaRule = "positive"
    """positive: only returns above the baseline move sigma | capped: both signs, at most
    sigma-cap x sigma per generation | bare: both signs, unbounded.
    """
    shaping: Literal["raw", "ranks", "signed-ranks"] = "raw"
    """Use returns as they are and sum over the pairs, or use ranks and average over the pairs: of
    all rollouts, or for mu of the pairs' differences with their signs, which compares rollouts from
    the same start only.
    """
    optimiser: Literal["sgd", "clipup", "adam"] = "sgd"
    """How mu follows its gradient; sigma always takes a plain step."""
    learning_rate_mu: float = setting(0.1, least=0.0)
    """Step size of mu, alpha_mu."""
    learning_rate_sigma: float = setting(0.2, least=0.0)
    """Step size of sigma, alpha_sigma."""
    momentum: float = setting(0.9, least=0.0, below=1.0)
    """Share of the last step that ClipUp and Adam keep (Adam's first decay)."""
    second_moment_decay: float = setting(0.999, least=0.0, below=1.0)
    """Share of the mean squared gradient that Adam keeps."""
    max_speed: float = setting(0.2, above=0.0)
    """Longest step of mu with ClipUp: a Euclidean norm, in units of the parameters."""
    initial_mu: float = 1.0
    """First mean of every parameter."""
    initial_sigma: float = setting(2.0, above=0.0)
    """First standard deviation of every parameter."""
    sigma_floor: float = setting(1e-3, above=0.0)
    """Smallest standard deviation, in units of the parameters."""
    sigma_cap: float = setting(0.2, above=0.0, most=1.0)
    """Largest relative change of a sigma per generation, with the capped rule."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.initial_sigma < self.sigma_floor:
            raise ConfigError(
                f"initial-sigma is {self.initial_sigma}; expected {self.sigma_floor} (sigma-floor)"
                " or more"
            )

    def scaled(self, sigma: float) -> Self:
        """Return this search at another scale: with this initial sigma, and steps and the floor in
        proportion.

        Steps of `sgd` are in proportion to sigma themselves; those of `clipup` and `adam` are
        lengths.
        """
        share = sigma / self.initial_sigma
        same = replace(
            self, initial_sigma=sigma, sigma_floor=min(self.sigma_floor, self.sigma_floor * share)
        )
        if self.optimiser == "sgd":
            return same
        return replace(
            same, learning_rate_mu=self.learning_rate_mu * share, max_speed=self.max_speed * share
        )

    def signs(self) -> tuple[int, ...]:
        """Rollouts of a row of eps: mu + eps and mu - eps, or mu + eps alone."""
        return (1, -1) if self.estimator == "symmetric" else (1,)

    @property
    def returns_shape(self) -> tuple[int, int]:
        """Shape of the returns of a generation: (N, 2), columns (+, -), or (2N, 1)."""
        return (self.pairs, 2) if self.estimator == "symmetric" else (2 * self.pairs, 1)

    def init(self, size: int) -> PGPEState:
        """Return the state before the first generation, of `size` parameters."""
        memory = dict.fromkeys(self._memory(), np.zeros(size))
        mu, sigma = np.full(size, float(self.initial_mu)), np.full(size, float(self.initial_sigma))
        return PGPEState(mu=mu, sigma=sigma, baseline=None, best=None, generation=0, **memory)

    def restore(self, values: Mapping[str, StateValue]) -> PGPEState:
        """Return the state from which `to_dict` made these values; a ValueError if it does not
        fit these settings.
        """
        state = PGPEState.from_dict(values)
        self._check_memory(state)
        return state

    def ask(self, state: PGPEState, rng: np.random.Generator) -> FloatArray:
        """Draw eps ~ N(0, diag(sigma^2)): (N, P) for pairs, (2N, P) for single rollouts.

        The thesis prints eps ~ N(mu, I sigma^2), and theta- = mu eps without the minus. With theta+
        = mu + eps and theta- = mu - eps it must be N(0, .).
        """
        return state.sigma * rng.standard_normal((self.returns_shape[0], state.mu.size))

    def tell(self, state: PGPEState, eps: FloatArray, returns: FloatArray) -> PGPEState:
        """Return the state after one update; the given state is not changed.

        Args:
            state: the state `eps` was drawn from.
            eps: from `ask`, (N, P) or (2N, P).
            returns: `returns_shape`, row n belongs to eps[n]; all finite.

        Raises:
            ValueError: a shape is wrong, or a value not finite.
            Diverged: the update would not be finite.
        """
        self._check_memory(state)
        rows, columns = self.returns_shape
        eps = finite_rows("eps", eps, (rows, state.mu.size))
        returns = comparable(returns, (rows, columns))
        best = float(returns.max()) if state.best is None else max(state.best, float(returns.max()))
        with np.errstate(all="ignore"):
            to_mu, to_sigma, baseline = self._factors(state, eps, returns, best)
            # The thesis prints mu + alpha S r_T; it must be T r_T with T_ij = eps_i^j.
            gradient_mu = weighted_sum(to_mu, eps)
            gradient_sigma = weighted_sum(to_sigma, sigma_characteristic(eps, state.sigma))
            if self.shaping != "raw":  # a mean; the paper's rule does not divide by N
                gradient_mu, gradient_sigma = gradient_mu / rows, gradient_sigma / rows
            moved = self._moved(state, gradient_mu, gradient_sigma)
            # Reports contain it, so it must be finite
            length = np.sqrt((moved["mu"] * moved["mu"]).sum())
        for value in (gradient_mu, gradient_sigma, *moved.values(), length, baseline or 0.0):
            if not np.isfinite(value).all():
                raise Diverged(f"the update after generation {state.generation} is not finite")
        generation = state.generation + 1
        return PGPEState(**moved, baseline=baseline, best=best, generation=generation)

    def _factors(
        self, state: PGPEState, eps: FloatArray, returns: FloatArray, best: float
    ) -> tuple[FloatArray, FloatArray, float | None]:
        """Return each row's weights for mu and for sigma, (R,) each, and the next baseline."""
        if self.shaping == "raw":
            to_mu, to_sigma, baseline = self._raw_factors(state, eps, returns, best)
        else:
            ranks = centred_ranks(returns)
            to_sigma, baseline = middle_returns(ranks), None
            if self.estimator == "plain":
                to_mu = to_sigma
            elif self.shaping == "ranks":
                to_mu = (ranks[:, 0] - ranks[:, 1]) / 2.0
            else:
                to_mu = signed_ranks(returns)
        if self.sigma_rule == "positive":
            to_sigma = np.maximum(to_sigma, 0.0)
        return to_mu, to_sigma, baseline

    def _raw_factors(
        self, state: PGPEState, eps: FloatArray, returns: FloatArray, best: float
    ) -> tuple[FloatArray, FloatArray, float | None]:
        middle = middle_returns(returns)
        baseline, following = self._baselines(state, eps, middle)
        to_sigma = baseline_contrast(middle, baseline, best)
        if self.estimator == "symmetric":
            to_mu = pair_contrast(returns, best, self.normaliser)
        elif self.normaliser == "sehnke":
            to_mu = to_sigma
        else:
            to_mu = plain_contrast(middle, baseline)
            to_sigma = np.zeros_like(to_mu) if level(best, baseline) else to_mu
        if self.baseline == "moving-average" and state.baseline is None:
            to_sigma = np.zeros_like(to_sigma)  # the first generation only sets the baseline
        return to_mu, to_sigma, following

    def _baselines(
        self, state: PGPEState, eps: FloatArray, middle: FloatArray
    ) -> tuple[float, float | None]:
        """Return the baseline of this update and the one to store."""
        if self.baseline == "none":
            return 0.0, None
        if self.baseline == "optimal":
            best_fit = optimal_baseline(middle, eps, state.sigma)
            return best_fit, best_fit
        mean = float(middle.mean())
        if state.baseline is None:
            return mean, mean
        return state.baseline, _BASELINE_MEMORY * state.baseline + (1.0 - _BASELINE_MEMORY) * mean

    def _moved(
        self, state: PGPEState, gradient_mu: FloatArray, gradient_sigma: FloatArray
    ) -> dict[str, FloatArray]:
        """Return the arrays of the next state, by name."""
        step = self.learning_rate_sigma * gradient_sigma
        sigma = step_sigma(
            state.sigma, step, self.sigma_rule, cap=self.sigma_cap, floor=self.sigma_floor
        )
        rate = self.learning_rate_mu
        if self.optimiser == "sgd":
            return {"mu": state.mu + rate * gradient_mu, "sigma": sigma}
        if self.optimiser == "clipup":
            velocity = clipup(
                gradient_mu,
                state.velocity,
                learning_rate=rate,
                momentum=self.momentum,
                max_speed=self.max_speed,
            )
            return {"mu": state.mu + velocity, "sigma": sigma, "velocity": velocity}
        step, first, second = adam(
            gradient_mu,
            (state.first_moment, state.second_moment),
            count=state.generation + 1,
            learning_rate=rate,
            decays=(self.momentum, self.second_moment_decay),
        )
        mu = state.mu + step
        return {"mu": mu, "sigma": sigma, "first_moment": first, "second_moment": second}

    def _memory(self) -> tuple[str, ...]:
        """Names of the state's arrays that this optimiser uses."""
        arrays = {"sgd": (), "clipup": ("velocity",), "adam": ("first_moment", "second_moment")}
        return arrays[self.optimiser]

    def _check_memory(self, state: PGPEState) -> None:
        for name in ("velocity", "first_moment", "second_moment"):
            expected = state.mu.size if name in self._memory() else 0
            if (count := getattr(state, name).size) != expected:
                raise ValueError(
                    f"state: {name} has {count} entries, expected {expected} with {self.optimiser}"
                )
