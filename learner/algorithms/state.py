"""The state of an algorithm between two generations: immutable, checked, and stored in checkpoints
as a dict.

Shapes: P is the number of parameters. Every array is float64 and read-only, so neither the
algorithm nor the recorder can change a state.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Final, Self, TypeAlias, TypeVar

import numpy as np

from farm.arrays import FloatArray
from farm.returns import penalised

StateValue: TypeAlias = FloatArray | float | int | None

S = TypeVar("S", bound="SearchState")

_FIGURES: Final = ("baseline", "best", "generation")  # all other fields are vectors


class Diverged(ArithmeticError):  # noqa: N818  it says what happened
    """An update would make the state non-finite; the previous state is unchanged."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchState:
    """The search distribution N(mu, diag(sigma^2)), baseline, best return and generation.

    Learner, recorder and checkpoint need only these fields. An algorithm that stores more adds
    fields in a subclass: vectors (P,), or empty ones if they are not used.

    Raises:
      ValueError: an array is not a finite float64 vector of mu's size, or a sigma is not positive.

    Example:
      ```python
      import numpy as np

      import farm

      state = farm.SearchState(mu=np.zeros(3), sigma=np.full(3, 0.5))
      assert farm.SearchState.from_dict(state.to_dict()).sigma.tolist() == [0.5, 0.5, 0.5]
      ```
    """

    mu: FloatArray
    """Mean of the search distribution, (P,)."""
    sigma: FloatArray
    """Standard deviation of each parameter, (P,), positive."""
    baseline: float | None = None
    """Return that counts as neither good nor bad; None before the first generation, or if it is not
    used.
    """
    best: float | None = None
    """Best return so far over the whole run (m); None before the first generation."""
    generation: int = 0
    """Number of updates done."""

    def __post_init__(self) -> None:
        """Copy the arrays, make them read-only, and check every value."""
        for name in self._vectors():
            object.__setattr__(self, name, _read_only(name, getattr(self, name)))
        self._check_sizes()
        if not (self.sigma > 0.0).all():
            raise ValueError(
                f"state: sigma must be positive everywhere, its least is {self.sigma.min()}"
            )
        for name in ("baseline", "best"):
            object.__setattr__(self, name, _scalar(name, getattr(self, name)))
        count = self.generation
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
            raise ValueError(f"state: generation must be an integer of 0 or more, not {count!r}")
        object.__setattr__(self, "generation", int(count))

    def spread(self, sigma: FloatArray) -> Self:
        """Return the state with these standard deviations (P,)."""
        return replace(self, sigma=sigma)

    @classmethod
    def _vectors(cls) -> list[str]:
        """Names of the fields that are vectors: mu, sigma, then those of a subclass."""
        return [each.name for each in fields(cls) if each.name not in _FIGURES]

    def _check_sizes(self) -> None:
        size = self.mu.size
        if size == 0:
            raise ValueError("state: mu must have one parameter or more, it is empty")
        if self.sigma.size != size:
            raise ValueError(f"state: sigma must have mu's size {size}, not {self.sigma.size}")
        for name in self._vectors()[2:]:
            if (count := getattr(self, name).size) not in (0, size):
                raise ValueError(f"state: {name} must be empty or of mu's size {size}, not {count}")

    def to_dict(self) -> dict[str, StateValue]:
        """Every field by its name, for a checkpoint; `from_dict` restores the same bits."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def from_dict(cls: type[S], values: Mapping[str, StateValue]) -> S:
        """Build the state from which `to_dict` made these values.

        Raises:
            ValueError: a key is missing or unknown, or its value has a wrong type, shape or range;
                the message names the key.
        """
        names = {each.name for each in fields(cls)}
        if missing := sorted(names - set(values)):
            raise ValueError(f"state: missing {', '.join(missing)}")
        if unknown := sorted(set(values) - names):
            raise ValueError(
                f"state: unknown {', '.join(unknown)}; known: {', '.join(sorted(names))}"
            )
        return cls(**dict(values))  # type: ignore[arg-type]  # __post_init__ checks every type


def _read_only(name: str, value: object) -> FloatArray:
    """Return a read-only copy of a finite float64 vector."""
    if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.ndim != 1:
        description = (
            f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else f"{value!r:.60}"
        )
        raise ValueError(f"state: {name} must be a float64 vector, not {description}")
    if not np.isfinite(value).all():
        raise ValueError(f"state: {name} must be finite everywhere")
    copy = np.array(value, dtype=np.float64, order="C")
    copy.setflags(write=False)
    return copy


def _scalar(name: str, value: object) -> float | None:
    """Return a finite Python float, or None as it is."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, float | int) or not np.isfinite(value):
        raise ValueError(f"state: {name} must be a finite number or None, not {value!r:.60}")
    return float(value)


def moved(state: S, returns: FloatArray, **arrays: FloatArray) -> S:
    """The next state: with these arrays replaced, and the best return updated.

    Raises:
      Diverged: an array is not finite, or a sigma is not positive.
    """
    for name, values in arrays.items():
        if not np.isfinite(values).all() or (name == "sigma" and not (values > 0.0).all()):
            raise Diverged(f"the update after generation {state.generation} is not finite")
    best = float(returns.max()) if state.best is None else max(state.best, float(returns.max()))
    return replace(state, **arrays, best=best, generation=state.generation + 1)


def finite_rows(name: str, array: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the array in C order, so that sums over its rows run in index order.

    Raises:
      ValueError: the shape is wrong, or a value is not finite.
    """
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has non-finite values, expected finite ones everywhere")
    return array


def comparable(returns: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Returns of a generation as an update uses them, `shape`: those of failed rollouts as in
    `farm.returns.penalised`.

    Raises:
      ValueError: the shape is wrong, or a value is not finite.
    """
    return penalised(finite_rows("returns", returns, shape))
