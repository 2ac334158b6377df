"""What is known of whole rollouts beside their returns: models, measures, shares of reward terms, control steps."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import TaskError
from farm.sim.channels import flat
from farm.sim.scene import MODEL
from farm.sim.trajectory import single
from farm.tasks.acting import shaped
from farm.tasks.base import Record, Task, TaskSpec

if TYPE_CHECKING:
    from farm.tasks.loop import Rollouts


def drawn(task: Task, rngs: Sequence[np.random.Generator | None]) -> IntArray:
    """Which of its models a task draws for each rollout, (B,).

    Raises:
      TaskError: it draws one that there is not.
    """
    count = len(task.simulated)
    indices = [0 if rng is None else task.which(rng) for rng in rngs]
    for each in indices:
        if isinstance(each, bool) or not isinstance(each, int | np.integer) or not 0 <= each < count:
            raise TaskError(f"which gave {each!r}; expected the index of a model, 0 to {count - 1}")
    return np.array(indices, dtype=int)


def measured(task: Task, record: Record) -> FloatArray:
    """The task's measures of whole rollouts, in their order (B, M).

    Raises:
      TaskError: one is missing, or a value is not within its bounds.
    """
    count = len(record.steps)
    if not task.measures:
        return np.empty((count, 0))
    outcomes, out = task.outcomes(record), np.empty((count, len(task.measures)))
    if not isinstance(outcomes, dict):
        raise TaskError(f"outcomes gave a {type(outcomes).__name__}; expected arrays by name")
    for column, each in enumerate(task.measures):
        values = np.where(record.failed, each.low, shaped(f"outcomes {each.name!r}", outcomes.get(each.name), (count,)))
        if bad := [value for value in values.tolist() if not each.low <= value <= each.high]:
            raise TaskError(
                f"measure {each.name!r} is {bad[0]:g}; its bounds are {each.low:g} to {each.high:g}: widen them, or "
                "clip the values in outcomes"
            )
        out[:, column] = values
    return out


def shares(task: Task, terms: FloatArray, clamped: BoolArray) -> FloatArray:
    """Each reward term's part of the returns, discounted and scaled (B, K).

    Args:
      task: the task.
      terms: (B, T, K), zero after the end.
      clamped: (B,) which returns were clamped; their parts are zero.
    """
    total = np.zeros((len(terms), terms.shape[2]))
    with np.errstate(over="ignore", invalid="ignore"):
        for t in range(terms.shape[1]):  # in this order, as the return
            total += task.config.gamma**t * terms[:, t]
        total *= task.return_scale
    return np.where(clamped[:, None], 0.0, total)


def step_shapes(spec: TaskSpec) -> dict[str, tuple[int, ...]]:
    """Shape of each part of a control step, in the order of a trace of kind `steps`."""
    shapes = {"observation": (spec.observation,), "action": (spec.action,), "terms": (len(spec.terms),)}
    return shapes | {f"channels/{channel.name}": channel.shape for channel in spec.channels}


def whole(spec: TaskSpec) -> tuple[int, int]:
    """Shape of a rollout's trace of kind `steps`, (T, N)."""
    return spec.steps, sum(int(np.prod(shape)) for shape in step_shapes(spec).values())


def stepped(task: Task, spec: TaskSpec, rollouts: "Rollouts", rows: IntArray) -> AnyArray:
    """The control steps of some rollouts with observations, parts as in `step_shapes`: (R, T, N), zero after the end.

    Observation and action are those before a step's physics, terms and channels those after it.
    """
    channels = task.show({name: frames[rows] for name, frames in rollouts.frames.items()})
    if len(task.simulated) > 1:
        which = np.eye(len(task.simulated))[rollouts.which[rows]]
        channels = channels | {MODEL: np.repeat(which[:, None], task.steps, axis=1)}
    parts = [rollouts.observations[rows], rollouts.actions[rows], rollouts.terms[rows]]
    if spec.channels:
        parts.append(flat(spec.channels, channels))
    values = np.concatenate([single(part) for part in parts], axis=2)
    values[np.arange(task.steps) >= rollouts.steps[rows][:, None]] = 0.0
    return values
