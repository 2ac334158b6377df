"""The evaluations that peers.py times, in a separate module, so that the workers of each backend can import it."""

import functools
import os
import time

import numpy as np

from farm.arrays import FloatArray
from farm.rollouts import Runner
from learner.run.config import configure
from learner.run.setup import problem

STILL = 50.0
"""Value of every parameter: so far from every joint position that the kernel is zero and no rollout ends early."""


@functools.cache
def runner() -> Runner:
    """The finger gait of the default preset, built once in each process."""
    return problem(configure(preset=os.environ.get("PRESET", "default"))).runner()


def gait(theta: FloatArray) -> FloatArray:
    """Returns of rollouts with parameters (B, P); both rollouts of a pair have the same perturbed start."""
    return runner().rollouts(theta, [(row // 2,) for row in range(len(theta))]).returns


def nothing(theta: FloatArray) -> FloatArray:
    """Evaluations that take no time."""
    return np.asarray(theta.sum(axis=1))


def pid(_: int = 0) -> int:
    """The process in which a worker runs."""
    time.sleep(0.1)
    return os.getpid()
