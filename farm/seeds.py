"""Seeds of all random numbers of a run. Pure functions.

The first number of each seed tells its use. All seeds have the same length, because numpy pads a
shorter seed with zeros: (7, 3) and (7, 3, 0) would give the same numbers.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from farm.errors import ConfigError

SEEDS: Final = 2**32
"""Seeds are below this: one 32-bit word each."""

_FEATURES, _EXPLORATION, _TRAINING, _EVALUATION, _START, _PILOT, _VALIDATION, _CONSTANT = range(
    1, 9
)


def features(seed: int) -> np.random.Generator:
    """Generator for the policy's random constants of a run, for example Fourier features."""
    return np.random.default_rng((_FEATURES, seed, 0, 0))


def start(seed: int) -> np.random.Generator:
    """Generator for the parameters at which a run's search starts."""
    return np.random.default_rng((_START, seed, 0, 0))


def exploration(seed: int, generation: int) -> np.random.Generator:
    """Generator for the perturbations eps of a generation."""
    return np.random.default_rng((_EXPLORATION, seed, generation, 0))


def training(seed: int, generation: int, start: int) -> tuple[int, ...]:
    """Seed of the task's perturbation for exploring rollouts: of a pair, or with several episodes
    of all that share it.

    `start` is the pair's number, or the episode's.
    """
    return (_TRAINING, seed, generation, start)


def generation(words: Sequence[int]) -> int | None:
    """Generation whose exploring rollouts have this seed; None if it is of another use."""
    return words[2] if words[0] == _TRAINING else None


def pilot(seed: int) -> np.random.Generator:
    """Generator for the directions that a run's pilot tries."""
    return np.random.default_rng((_PILOT, seed, 0, 0))


def pilot_start(seed: int, start: int) -> tuple[int, ...]:
    """Seed of the task's perturbation for a start of a run's pilot."""
    return (_PILOT, seed, 1, start)


def validation(seed: int, start: int) -> tuple[int, ...]:
    """Seed of the task's perturbation for a start from which a run's mean policies are
    validated.
    """
    return (_VALIDATION, seed, 0, start)


def constant() -> np.random.Generator:
    """Generator for constant actions that policies are compared with, alike for all runs."""
    return np.random.default_rng((_CONSTANT, 0, 0, 0))


def evaluation_start(seed: int, rollout: int) -> tuple[int, ...]:
    """Seed of the task's perturbation for one rollout of an evaluation."""
    return (_EVALUATION, seed, rollout, 0)


def numbered_start(number: object) -> tuple[int, ...]:
    """Seed of the task's perturbation for the start that `farm evaluate` has at this number.

    Raises:
      ConfigError: it is no whole number below SEEDS.
    """
    whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    if not whole or not 0 <= number < SEEDS:
        raise ConfigError(
            f"seed {str(number)[:40]!r}; expected a whole number from 0 to {SEEDS - 1}"
        )
    return evaluation_start(0, int(number))
