"""Results of whole rollouts beside their returns: the task's measures, and what each reward term contributes."""

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import TaskError
from farm.tasks.acting import shaped
from farm.tasks.base import Record, Task


def measured(task: Task, record: Record) -> FloatArray:
    """The task's measures of whole rollouts, in their order (B, M).

    Raises:
      TaskError: one is missing, or a value is not within its bounds.
    """
    count = len(record.steps)
    if not task.measures:
        return np.empty((count, 0))
    given, out = task.outcomes(record), np.empty((count, len(task.measures)))
    if not isinstance(given, dict):
        raise TaskError(f"outcomes gave a {type(given).__name__}; expected arrays by name")
    for column, each in enumerate(task.measures):
        values = np.where(record.failed, each.low, shaped(f"outcomes {each.name!r}", given.get(each.name), (count,)))
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
