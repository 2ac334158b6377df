"""The nominal start of a task: its positions, its observation, and the spread of observations from
there.
"""

from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import TaskError
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Batch
from farm.tasks.probe import tried

_ROLLOUTS: Final = 32
_FEW: Final = 2
_QUARTILES: Final = 1.349  # between those of a normal distribution, in standard deviations
_FLOOR: Final = 1.0 / 3.0  # of a part's mean spread


def start(task: Task) -> tuple[FloatArray, FloatArray | None]:
    """Positions at the nominal start (nq,), and poses of the mocap bodies (nmocap, 7); None without
    any.
    """
    arrays = tried(task, 1, lambda sim: Batch(task, sim, [None]).start)
    return arrays["qpos"][0], arrays["mocap"][0] if "mocap" in arrays else None


def nominal(task: Task) -> FloatArray:
    """The observation at the nominal start, (d,).

    Raises:
      ConfigError: the task cannot start.
      TaskError: the observation is not finite.
    """
    return _observed(task, np.empty((0, task.action_size)))[0]


def standard(task: Task, action: float) -> dict[str, FloatArray]:
    """Origin m and spread s of the observation x, (d,) each: (x - m) / s is standardised.

    m is x at the nominal start. s is the interquartile range of x, divided by the normal
    distribution's, over 32 rollouts from there, each with a constant action, normal with standard
    deviation `action`: outliers must not widen it. Numbers that hardly change must not count as
    much as others: s is at least a third of its mean over that part of the observation
    (`Task.parts`), and 1 if a part is constant. It belongs to the task: equal in all runs.

    Raises:
      ConfigError: the task cannot start.
      TaskError: an observation is not finite.
    """
    x = _observed(task, np.random.default_rng(0).normal(0.0, action, (_ROLLOUTS, task.action_size)))
    low, high = np.quantile(x, (0.25, 0.75), axis=0)
    spread = (high - low) / _QUARTILES
    parts = task.parts or (x.shape[1],)
    if task.space and sum(parts) < len(spread):
        parts = (*parts, len(spread) - sum(parts))  # what the action space adds
    for part in np.split(spread, np.cumsum(parts)[:-1]):  # views
        mean = part.mean()
        np.maximum(part, _FLOOR * mean if mean > 0.0 else 1.0, out=part)
    return {"origin": x[0].copy(), "spread": spread}


def observed(task: Task, count: int) -> FloatArray:
    """Observations of rollouts with random constant actions from the nominal start, (N, d).

    There are about `count` of them; fewer if rollouts end early.

    Raises:
      ConfigError: the task cannot start.
      TaskError: an observation is not finite.
    """
    rollouts = max(_FEW, -(-count // task.steps))
    return _observed(task, np.random.default_rng(0).normal(0.0, 0.5, (rollouts, task.action_size)))


def _observed(task: Task, actions: FloatArray) -> FloatArray:
    """Observations of rollouts with constant actions (B, A) from the nominal start, which is the
    first, (N, d).
    """

    def look(sim: Sim) -> list[FloatArray]:
        # A task's own engine may have fewer rows than there are actions.
        observations, size = [], sim.engine.size
        for constant in np.split(actions, range(size, len(actions), size)):
            batch = Batch(task, sim, [None] * max(1, len(constant)))
            observations.append(np.array(batch.observe(), dtype=float))
            while len(constant) and not batch.over:
                batch.step(constant[batch.active])
                if not batch.over:
                    observations.append(np.array(batch.observe(), dtype=float))
        return observations

    x = np.concatenate(tried(task, max(1, len(actions)), look))
    if not np.isfinite(x).all():
        raise TaskError("observe is not finite")
    return x
