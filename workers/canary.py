"""A fingerprint of this machine's numbers: a few rollouts, compared bit for bit.

Kinds of processors, compilers and library versions round differently (x86-64 processors with AVX2 do not among
themselves: docs/protocol.md). Machines with the same canary digest give the same numbers for the same jobs; the canary
goes through everything that a rollout is made of: products and cosines of the policy, taxels, contact points, rewards,
grips, perturbed physics.
"""

import hashlib
from functools import cache
from typing import Final

import numpy as np

from farm import randomness
from farm.policy import Features, Policy, PolicyConfig
from farm.states import STATES
from farm.tasks.finger_gait import Perturbation, TaskConfig
from workers.simulation import Simulation

_CONTROLLERS: Final = ("direct", "projected", "kernel", "cosine")
_STATE: Final = "joints+tactile"
_FEATURES: Final = 300
_STEPS: Final = 5


@cache
def digest() -> str:
    """SHA-256 of what the canary's rollouts gave; takes some tenths of a second, once a process."""
    said = hashlib.sha256()
    size = STATES[_STATE].size
    task = TaskConfig(state=_STATE, steps=_STEPS)
    perturbation = Perturbation.draw(np.random.default_rng(randomness.trial(0, 0)), _STEPS)
    simulation = None
    for controller in _CONTROLLERS:
        config = PolicyConfig(controller=controller, features=_FEATURES)
        policy = Policy(config, size, _features(config, size))
        if simulation is None:
            simulation = Simulation(task, policy)
        simulation.policy = policy
        theta = 0.3 * _numbers(2 * policy.size).reshape(2, policy.size)
        rollouts = simulation.run(theta, [None, perturbation])
        for values in (rollouts.outcome.returns, rollouts.outcome.terms, rollouts.frames.qpos, rollouts.actions):
            said.update(np.ascontiguousarray(values).tobytes())
    return said.hexdigest()


def _features(config: PolicyConfig, size: int) -> Features:
    """Features that do not depend on a random generator's version."""
    count = 0 if config.controller == "kernel" else config.features
    frequencies = _numbers(count * size).reshape(count, size)
    return Features(frequencies=frequencies, phases=np.pi * (1.0 + _numbers(count)))


def _numbers(count: int) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """Spread over (-1, 1), the same everywhere: multiples of the golden ratio, in whole numbers."""
    whole = (np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(12)
    return whole.astype(np.float64) / 2.0**51 - 1.0
