"""Seeds of all random numbers of a run. Pure functions.

Each use has its own first number, and all seeds have equal lengths: numpy pads a shorter seed
with zeros, so that (7, 3) and (7, 3, 0) would give the same numbers.
"""

from typing import Final

import numpy as np

SEEDS: Final = 2**32
"""Seeds are below this: one 32-bit word each."""

_FEATURES, _EXPLORATION, _TRAINING, _TRIAL = range(1, 5)


def features(seed: int) -> np.random.Generator:
    """For the random Fourier features of a run."""
    return np.random.default_rng((_FEATURES, seed, 0, 0))


def exploration(seed: int, generation: int) -> np.random.Generator:
    """For a generation's eps."""
    return np.random.default_rng((_EXPLORATION, seed, generation, 0))


def training(seed: int, generation: int, pair: int) -> tuple[int, ...]:
    """Seed of the perturbation for training a pair."""
    return (_TRAINING, seed, generation, pair)


def trial(seed: int, rollout: int) -> tuple[int, ...]:
    """Seed of the perturbation of one rollout of an evaluation."""
    return (_TRIAL, seed, rollout, 0)
