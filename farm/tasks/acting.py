"""A policy that acts in rollouts that are stepped together, and what each of them remembers."""

from typing import Any, Protocol

import numpy as np

from farm.arrays import AnyArray, FloatArray, IntArray
from farm.errors import TaskError


class Acts(Protocol):
    """The methods that rollouts need from a policy. It may have `memory` and `scale`, as `farm.Policy`."""

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Compute from the parameters (B, P) what stays constant during a rollout, (B, ...)."""
        ...

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d)."""
        ...


class Acting:
    """A policy in B rollouts. It keeps their memories, so each rollout must act once in each of its control steps."""

    def __init__(self, policy: Acts, theta: FloatArray) -> None:
        """Prepare parameters (B, P), in the search's units; all rollouts are at their starts.

        Raises:
          TaskError: `prepare` gives something else than one array with a row per rollout.
        """
        scale: FloatArray | None = getattr(policy, "scale", None)
        prepared: object = policy.prepare(theta if scale is None else scale * theta)
        if not isinstance(prepared, np.ndarray):
            raise TaskError(
                f"prepare of the policy gave a {type(prepared).__name__}; expected one array, with a row per rollout: "
                "join what act needs, and split it there"
            )
        self._policy: Any = policy
        self._all = self._prepared = shaped("prepare of the policy", prepared, (len(theta), *prepared.shape[1:]))
        self._rows = np.arange(len(theta))  # of which `_prepared` is
        self._first: FloatArray | None = getattr(policy, "memory", None)
        self._memory = None if self._first is None else np.tile(self._first, (len(theta), 1))

    def act(self, x: FloatArray, rows: IntArray | None = None) -> AnyArray:
        """Actions (n, A), which nothing has checked.

        Args:
          x: observations (n, d).
          rows: which rollouts these are, (n,); None: all.

        Raises:
          TaskError: a policy with memory does not give actions and memories (n, m).
        """
        rows = np.arange(len(self._all)) if rows is None else rows
        if rows is not self._rows:
            if not np.array_equal(rows, self._rows):
                self._prepared = self._all[rows]
            self._rows = rows
        if self._memory is None:
            action: AnyArray = self._policy.act(self._prepared, x)
            return action
        result: object = self._policy.act(self._prepared, x, self._memory[rows])
        if not isinstance(result, tuple) or len(result) != 2:
            raise TaskError(
                f"act of the policy gave a {type(result).__name__}; expected (action, memory), as the policy has memory"
            )
        action, after = result
        self._memory[rows] = shaped("memory from act of the policy", after, (len(rows), self._memory.shape[1]))
        return action

    def forget(self, rows: IntArray) -> None:
        """Let rollouts (n,) remember what they did at their starts."""
        if self._memory is not None:
            self._memory[rows] = self._first


def shaped(name: str, values: Any, shape: tuple[int, ...]) -> AnyArray:  # noqa: ANN401  a task's result
    """Return the values if they are an array of this shape.

    Raises:
      TaskError: they are not; names the array, its shape and the expected one.
    """
    if not isinstance(values, np.ndarray) or values.shape != shape:
        got = f"an array of shape {values.shape}" if isinstance(values, np.ndarray) else f"a {type(values).__name__}"
        raise TaskError(f"{name} gave {got}; expected an array of shape {shape}")
    if values.dtype.kind not in "biuf":
        raise TaskError(f"{name} gave an array of {values.dtype}; expected real numbers")
    return values
