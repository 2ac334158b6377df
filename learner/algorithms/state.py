"""What an algorithm stores between two generations: frozen, checked, and given to a checkpoint as a dict.

Shapes: P is the number of parameters. Every array is float64 and read-only, so a state that was
handed to the algorithm, the recorder or a checkpoint is the same afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Final, TypeAlias, TypeVar

import numpy as np

from farm.arrays import FloatArray

StateValue: TypeAlias = FloatArray | float | int | None

S = TypeVar("S", bound="SearchState")

_FIGURES: Final = ("baseline", "best", "generation")  # all other fields are vectors


class Diverged(ArithmeticError):  # noqa: N818  it says what happened
    """An update would have made the state non-finite; the state before it is untouched."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchState:
    """The search distribution N(mu, diag(sigma^2)) and the running figures around it.

    Learner, recorder and checkpoint know no more of any algorithm. One that remembers more adds fields of its own in
    a subclass: vectors, (P,), or empty where they are not used.
    """

    mu: FloatArray
    """Mean of the search distribution, (P,)."""
    sigma: FloatArray
    """Standard deviation of each parameter, (P,), positive."""
    baseline: float | None = None
    """Return that counts as neither good nor bad; None until a generation has set it, or if there is none."""
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
            raise ValueError(f"state: sigma must be positive everywhere, its least is {self.sigma.min()}")
        for name in ("baseline", "best"):
            object.__setattr__(self, name, _scalar(name, getattr(self, name)))
        count = self.generation
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 0:
            raise ValueError(f"state: generation must be an integer of 0 or more, not {count!r}")
        object.__setattr__(self, "generation", int(count))

    @classmethod
    def _vectors(cls) -> list[str]:
        """Names of the fields that are vectors: mu, sigma, then a subclass' own."""
        return [each.name for each in fields(cls) if each.name not in _FIGURES]

    def _check_sizes(self) -> None:
        size = self.mu.size
        if size == 0:
            raise ValueError("state: mu must have one parameter or more, it is empty")
        if self.sigma.size != size:
            raise ValueError(f"state: sigma must have mu's size {size}, not {self.sigma.size}")
        for name in self._vectors()[2:]:
            if (found := getattr(self, name).size) not in (0, size):
                raise ValueError(f"state: {name} must be empty or of mu's size {size}, not {found}")

    def to_dict(self) -> dict[str, StateValue]:
        """Give every field by its name, for a checkpoint; `from_dict` takes it back bit by bit."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @classmethod
    def from_dict(cls: type[S], values: Mapping[str, StateValue]) -> S:
        """Build the state that `to_dict` gave.

        Raises:
            ValueError: a key is missing or unknown, or its value has a wrong type, shape or range;
                the message names the key.
        """
        known = {each.name for each in fields(cls)}
        if missing := sorted(known - set(values)):
            raise ValueError(f"state: missing {', '.join(missing)}")
        if unknown := sorted(set(values) - known):
            raise ValueError(f"state: unknown {', '.join(unknown)}; known: {', '.join(sorted(known))}")
        return cls(**dict(values))  # type: ignore[arg-type]  # __post_init__ checks every type


def _read_only(name: str, value: object) -> FloatArray:
    """Return an own, read-only copy of a finite float64 vector."""
    if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.ndim != 1:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)
        raise ValueError(f"state: {name} must be a float64 vector, not {found}")
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
        raise ValueError(f"state: {name} must be a finite number or None, not {value!r}")
    return float(value)


def moved(state: S, returns: FloatArray, **arrays: FloatArray) -> S:
    """The next state: some of its arrays are new, and the best of these returns is noted.

    Raises:
      Diverged: an array is not finite, or a sigma is not positive.
    """
    for name, values in arrays.items():
        if not np.isfinite(values).all() or (name == "sigma" and not (values > 0.0).all()):
            raise Diverged(f"the update after generation {state.generation} is not finite")
    best = float(returns.max()) if state.best is None else max(state.best, float(returns.max()))
    return replace(state, **arrays, best=best, generation=state.generation + 1)


def finite_rows(name: str, array: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the array in C order, so that sums over its rows run in index order."""
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has non-finite values, expected finite ones everywhere")
    return array
