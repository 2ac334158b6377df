"""An upper level over learnt gaits: it lets one policy act until its goal grip is felt, then the next.

Plage 2016, 5.2: "an upper level control policy can then control the finger gaiting". This one feels what the task's
success feels: which fingertips press.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import ConfigError
from farm.tasks.finger_gait.hand import FINGERS, GRIPS
from farm.tasks.finger_gait.physics import CAPACITY
from farm.tasks.finger_gait.task import (
    PRESSES,
    SUBSTEPS,
    SUCCESS_STEPS,
    Perturbation,
    stayed,
    touching,
)
from learner.replay import Stored


@dataclass(frozen=True)
class Chained:
    """Rollouts of a chain."""

    changes: IntArray
    """(B,) changes of grip until the end, or until the object was dropped or out of place."""
    acting: IntArray
    """(B, T) which policy acted, -1 after the end."""
    force: FloatArray
    """(B, T, 3) how hard each fingertip pressed [N], zero after the end."""


def chain(policies: Sequence[Stored], perturbations: Sequence[Perturbation], steps: int) -> Chained:
    """Run policies in turn, the first one first, each from the grip in which the one before it ended.

    Args:
      policies: each one's goal grip has to be the next one's start grip.
      perturbations: (B,) drawn for so many steps.
      steps: control steps.

    Raises:
      ConfigError: the policies do not follow each other, or hold different objects.
    """
    tasks = [policy.simulation.task for policy in policies]
    for one, other in zip(tasks, [*tasks[1:], tasks[0]], strict=True):
        if (one.config.goal_grip, one.config.object) != (other.config.start_grip, other.config.object):
            raise ConfigError(f"a gait to {one.config.goal_grip} is not followed by one from {other.config.start_grip}")
    batches = [_run(policies, perturbations[i : i + CAPACITY], steps) for i in range(0, len(perturbations), CAPACITY)]
    parts = ([getattr(batch, name) for batch in batches] for name in ("changes", "acting", "force"))
    return Chained(*(np.concatenate(part) for part in parts))


def _run(policies: Sequence[Stored], perturbations: Sequence[Perturbation], steps: int) -> Chained:
    """As many rollouts as are stepped together."""
    tasks = [policy.simulation.task for policy in policies]
    count, first = len(perturbations), policies[0].simulation
    stepper, start, noise = first.begin(list(perturbations))
    assert noise is not None
    weights = [p.simulation.policy.weights(np.repeat(p.mu[None], count, axis=0)) for p in policies]
    goals = np.array([[finger in GRIPS[task.config.goal_grip] for finger in FINGERS] for task in tasks])
    released, last = start.frames.pose, np.repeat(tasks[0].commands[None], count, axis=0)
    turn, felt, changes = (np.zeros(count, dtype=int) for _ in range(3))
    acting, force = np.full((count, steps), -1), np.zeros((count, steps, len(FINGERS)))
    active, now = np.arange(count), start.frames
    for t in range(steps):
        for i, (policy, task) in enumerate(zip(policies, tasks, strict=True)):
            mine = turn[active] == i
            rows = active[mine]
            if len(rows):
                x = task.observe(now.at(np.flatnonzero(mine)), noise[rows, t])
                actions = policy.simulation.policy.actions(weights[i][rows], x)
                last[rows] = policy.simulation.policy.targets(actions, task.commands, last[rows])
        stepper.ctrl[active] = last[active]
        stepper.step(active, SUBSTEPS)
        now = stepper.frames(active)
        pressing = now.force.sum(axis=-1)
        acting[active, t], force[active, t] = turn[active], pressing
        felt[active] = np.where(((pressing >= PRESSES) == goals[turn[active]]).all(axis=-1), felt[active] + 1, 0)
        going = stayed(now.pose, released[active]) & touching(now.force) & ~stepper.blown_up(active)
        there = active[going & (felt[active] >= SUCCESS_STEPS)]
        changes[there] += 1
        turn[there] = (turn[there] + 1) % len(policies)
        felt[there] = 0
        active, now = active[going], now.at(np.flatnonzero(going))
        if not len(active):
            break
    return Chained(changes, acting, force)
