"""CMA-ES and its separable form, by the library `cmaes` (Shibata). Only this module imports it.

Hansen 2016, The CMA evolution strategy: a tutorial; Ros & Hansen 2008, A simple modification in
CMA-ES achieving linear time and space complexity. The search distribution is N(mu, step^2 C): C is
any covariance matrix, or a diagonal one.

The library's object exists for one call: it is made from our state, which consists of arrays, used,
and read back. It uses BLAS, LAPACK and numpy's exponential, so the last bits depend on the
learner's processor and its number of BLAS threads, unlike with all other algorithms here. On one
machine a run can be repeated and resumed bit by bit; workers make no difference.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import ConfigError
from farm.settings import Settings, setting
from learner.algorithms.state import (
    Diverged,
    SearchState,
    StateValue,
    comparable,
    finite_rows,
    moved,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class CMAState(SearchState):
    """The search distribution and its evolution paths; sigma is step sqrt(diag C)."""

    step: FloatArray
    """Step size, (1,)."""
    covariance: FloatArray
    """C: its upper triangle row by row, (P (P + 1) / 2,), or its diagonal, (P,)."""
    step_path: FloatArray
    """Evolution path of the step size, (P,)."""
    covariance_path: FloatArray
    """Evolution path of the covariance, (P,)."""

    def spread(self, sigma: FloatArray) -> Self:
        """Return the state with these standard deviations (P,), and no correlations."""
        step = float(np.exp(np.log(sigma).mean()))
        variances = (sigma / step) ** 2
        covariance = variances
        if self.covariance.size != sigma.size:
            covariance = np.zeros(self.covariance.size)
            covariance[diagonal(sigma.size)] = variances
        return replace(self, sigma=sigma, step=np.array([step]), covariance=covariance)

    def _check_sizes(self) -> None:
        size = self.mu.size
        sizes = {"sigma": (size,), "step": (1,), "covariance": (size, size * (size + 1) // 2)}
        for name in self._vectors()[1:]:
            if (count := getattr(self, name).size) not in sizes.get(name, (size,)) or not count:
                raise ValueError(f"state: {name} has {count} entries, with {size} parameters")


@dataclass(frozen=True, kw_only=True)
class CMAES(Settings):
    """CMA-ES with a full covariance, by the library cmaes (Hansen 2016)."""

    population: int = setting(20, least=4)
    """Rollouts per generation."""
    initial_mu: float = setting(0.0, least=-1e30, most=1e30)
    """First mean of every parameter."""
    initial_sigma: float = setting(1.0, above=0.0)
    """First standard deviation of every parameter."""

    name: ClassVar[str] = "cma-es"
    optimiser: ClassVar[str] = "CMA"
    """The library's class."""
    sizes: ClassVar[tuple[int, int]] = (1, 1000)
    """Smallest and largest number of parameters: an update with a full covariance takes population
    x P^2 numbers.
    """
    stored: ClassVar[str] = "_c_1d"
    """The library's attribute that holds C as it is stored here."""

    def scaled(self, sigma: float) -> Self:
        """Return this search at another scale: with this initial sigma; steps follow from it."""
        return replace(self, initial_sigma=sigma)

    def signs(self) -> tuple[int, ...]:
        """Rollouts of a row of eps: mu + eps alone."""
        return (1,)

    def init(self, size: int) -> CMAState:
        """Return the state before the first generation, of `size` parameters.

        Raises:
          ConfigError: cmaes is not installed, or does not support this number of parameters.
        """
        least, most = self.sizes
        if not least <= size <= most:
            raise ConfigError(
                f"the policy has {size} parameters; {self.name} takes {least} to {most}"
            )
        search = self._library()(
            mean=np.full(size, float(self.initial_mu)), sigma=float(self.initial_sigma)
        )
        return CMAState(**self._read(search))

    def restore(self, values: Mapping[str, StateValue]) -> CMAState:
        """Return the state from which `to_dict` made these values."""
        state = CMAState.from_dict(values)
        if state.covariance.size != self._entries(state.mu.size):
            raise ValueError(
                f"state: covariance has {state.covariance.size} entries, which {self.name} does not"
                " have"
            )
        return state

    def ask(self, state: CMAState, rng: np.random.Generator) -> FloatArray:
        """Draw eps ~ N(0, step^2 C), (population, P)."""
        search = self._write(state)
        search.reseed_rng(int(rng.integers(2**32)))
        return np.stack([search.ask() - state.mu for _ in range(self.population)])

    def tell(self, state: CMAState, eps: FloatArray, returns: FloatArray) -> CMAState:
        """Return the state after one update.

        Args:
          state: the state `eps` was drawn from.
          eps: from `ask`, (population, P).
          returns: (population, 1); all finite.

        Raises:
          ValueError: a shape is wrong, or a value not finite.
          Diverged: the update would not be finite.
        """
        eps = finite_rows("eps", eps, (self.population, state.mu.size))
        returns = comparable(returns, (self.population, 1))
        search = self._write(state)
        with np.errstate(all="ignore"):
            try:
                search.tell(
                    [
                        (state.mu + row, -float(value))
                        for row, value in zip(eps, returns[:, 0], strict=True)
                    ]
                )
                arrays = self._read(search)
            except (AssertionError, ArithmeticError, np.linalg.LinAlgError) as error:
                raise Diverged(
                    f"the update after generation {state.generation} failed: {error}"
                ) from None
        return moved(state, returns, **arrays)

    def _entries(self, size: int) -> int:
        """Number of values that store the covariance of this number of parameters."""
        return size * (size + 1) // 2

    def _library(self) -> Any:  # noqa: ANN401  a class of the library's
        try:
            import cmaes
        except ImportError:
            raise ConfigError(f"algorithm {self.name} needs cmaes: pip install cmaes") from None
        return getattr(cmaes, self.optimiser)

    def _write(self, state: CMAState) -> Any:  # noqa: ANN401  the library's object
        """The library's object in this state."""
        mean, step = np.array(state.mu), float(state.step[0])
        search = self._library()(mean=mean, sigma=step, population_size=self.population)
        values = {
            "_p_sigma": np.array(state.step_path),
            "_pc": np.array(state.covariance_path),
            "_g": state.generation,
        }
        search.__setstate__(
            {**search.__getstate__(), **values, self.stored: np.array(state.covariance)}
        )
        return search

    def _read(self, search: Any) -> dict[str, Any]:  # noqa: ANN401
        """Arrays of our state from the library's object."""
        values = search.__getstate__()
        step, covariance = float(values["_sigma"]), np.array(values[self.stored])
        deviation = np.sqrt(self._diagonal(covariance, len(values["_mean"])))
        return {
            "mu": np.array(values["_mean"]),
            "sigma": step * deviation,
            "step": np.array([step]),
            "covariance": covariance,
            "step_path": np.array(values["_p_sigma"]),
            "covariance_path": np.array(values["_pc"]),
        }

    def _diagonal(self, covariance: FloatArray, size: int) -> FloatArray:
        """Variances, (P,), from the stored form of C."""
        return covariance[diagonal(size)]


def diagonal(size: int) -> IntArray:
    """Where an upper triangle of this size, row by row, has its diagonal, (size,)."""
    return np.cumsum([0, *range(size, 1, -1)])


@dataclass(frozen=True, kw_only=True)
class SepCMA(CMAES):
    """CMA-ES with a diagonal covariance, for many parameters."""

    name: ClassVar[str] = "sep-cma"
    optimiser: ClassVar[str] = "SepCMA"
    sizes: ClassVar[tuple[int, int]] = (2, 10_000_000)
    stored: ClassVar[str] = "_C"

    def _entries(self, size: int) -> int:
        return size

    def _diagonal(self, covariance: FloatArray, size: int) -> FloatArray:  # noqa: ARG002
        return covariance
