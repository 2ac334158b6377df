"""What the backends of peers.py evaluate; a module of its own, so that their workers can import it."""

import functools
import os
import time

import numpy as np

from farm.arrays import FloatArray
from farm.rollouts import Runner
from learner.config import configure
from learner.setup import problem

STILL = 50.0
"""Every parameter: so far from any joint position that the kernel is zero; no rollout ends early."""


@functools.cache
def runner() -> Runner:
    """The finger gait of the default preset, built once in each process."""
    return problem(configure(preset=os.environ.get("PRESET", "default"))).runner()


def gait(theta: FloatArray) -> FloatArray:
    """Returns of rollouts (B, P), the two of a pair from one perturbed start."""
    return runner().rollouts(theta, [(row // 2,) for row in range(len(theta))]).returns


def nothing(theta: FloatArray) -> FloatArray:
    """Evaluations that take no time."""
    return np.asarray(theta.sum(axis=1))


def pid(_: int = 0) -> int:
    """Where a worker runs."""
    time.sleep(0.1)
    return os.getpid()
