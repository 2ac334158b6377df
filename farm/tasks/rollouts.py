"""Finished rollouts: their arrays, returns and measures, and what is shown or sent of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray, shaped
from farm.errors import TaskError
from farm.returns import RETURN_FLOOR
from farm.sim.channels import flat
from farm.sim.scene import MODEL, Scene
from farm.sim.trajectory import Trajectory, single
from farm.tasks.base import Record, Task, TaskSpec
from farm.tasks.disturbances import CHANNELS

Seed = tuple[int, ...] | None
"""Seed of a rollout's random numbers; None for nominal conditions."""


@dataclass(frozen=True)
class Rollouts:
    """B finished rollouts; T control steps, F frames: T, or T x substeps at physics rate."""

    returns: FloatArray
    """(B,)"""
    success: BoolArray
    """(B,); false if the task does not define success"""
    ended: BoolArray
    """(B,) whether the task ended it before its last step"""
    failed: BoolArray
    """(B,) whether the simulation became unstable, or the task raised an error or gave numbers that
    are not finite
    """
    clamped: BoolArray
    """(B,) whether it has no return: it failed, or the return overflowed"""
    steps: IntArray
    """(B,) control steps until the end, including the last one"""
    terms: FloatArray
    """(B, T, K), zero after the end."""
    actions: FloatArray
    """(B, T, A), zero after the end."""
    start: Mapping[str, FloatArray]
    """Measured values at the start, qpos and (if there are mocap bodies) mocap, (B, ...)."""
    frames: Mapping[str, FloatArray]
    """Measured values in every frame, zero after the end, (B, F, ...)."""
    which: IntArray
    """(B,) index of each one's model among the task's"""
    measures: FloatArray
    """Values of the task's measures, in their order (B, M)"""
    moments: FloatArray
    """Moments of the observations, (B, 1 + 2 d) as in `farm.moments`; (B, 0) if not requested."""
    observations: AnyArray
    """Observations before each control step, zero after the end, (B, T, d) in single precision;
    (B, 0) if not requested.
    """

    @property
    def flags(self) -> BoolArray:
        """success, ended, failed, clamped, (B, 4)."""
        return np.stack([self.success, self.ended, self.failed, self.clamped], axis=1)

    @staticmethod
    def joined(parts: Sequence["Rollouts"]) -> "Rollouts":
        """Concatenate rollouts of one task."""
        return (
            parts[0] if len(parts) == 1 else _each(lambda *values: np.concatenate(values), *parts)
        )

    def at(self, rows: slice | IntArray) -> "Rollouts":
        """Select some rollouts."""
        return _each(lambda values: values[rows], self)


def drawn(task: Task, rngs: Sequence[np.random.Generator | None]) -> IntArray:
    """Draw one of a task's models for each rollout, (B,).

    Raises:
      TaskError: it draws one that there is not.
    """
    count = len(task.simulated)
    indices = [0 if rng is None else task.which(rng) for rng in rngs]
    for each in indices:
        if (
            isinstance(each, bool)
            or not isinstance(each, int | np.integer)
            or not 0 <= each < count
        ):
            raise TaskError(f"which gave {each!r}; expected the index of a model, 0 to {count - 1}")
    return np.array(indices, dtype=int)


def discounted(terms: FloatArray, gamma: float, scale: float) -> tuple[FloatArray, BoolArray]:
    """Return R = scale * sum_t gamma^t r_t, t from 0.

    Args:
      terms: (B, T, K) reward terms of every step, zero after the end.
      gamma: discount factor.
      scale: factor of the sum.

    Returns:
      returns (B,), and (B,) where the sum overflowed and was clamped to RETURN_FLOOR.
    """
    total = np.zeros(len(terms))
    with np.errstate(over="ignore", invalid="ignore"):
        reward = terms.sum(axis=-1)
        for t in range(terms.shape[1]):
            total += gamma**t * reward[:, t]
        total *= scale
        clamped = ~((total >= RETURN_FLOOR) & (total < np.inf))  # catches nan as well
    return np.where(clamped, RETURN_FLOOR, total), clamped


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
        values = np.where(
            record.failed,
            each.low,
            shaped(f"outcomes {each.name!r}", outcomes.get(each.name), (count,)),
        )
        if bad := [value for value in values.tolist() if not each.low <= value <= each.high]:
            raise TaskError(
                f"measure {each.name!r} is {bad[0]:g}; its bounds are {each.low:g} to"
                f" {each.high:g}: widen them, or clip the values in outcomes"
            )
        out[:, column] = values
    return out


def trajectory(
    task: Task, spec: TaskSpec, scene: Scene, rollouts: Rollouts, row: int
) -> Trajectory:
    """One rollout, frame by frame, its start first."""
    parts = next(iter(rollouts.frames.values())).shape[1] // task.steps
    steps = int(rollouts.steps[row])
    control = np.repeat(np.arange(steps), parts)
    frames = whole(rollouts, row)
    terms, actions, which = rollouts.terms[row], rollouts.actions[row], int(rollouts.which[row])
    return Trajectory.of(
        times=np.arange(steps * parts + 1, dtype=float) * (task.period / parts),
        bodies=scene.each[which].poses(frames["qpos"], frames.get("mocap")),
        actions=np.concatenate([np.zeros((1, actions.shape[1])), actions[control]]),
        terms=np.concatenate([np.zeros((1, terms.shape[1])), terms[control]]),
        channels=shown(task, frames) | scene.said(which, len(frames["qpos"])),
        value=float(rollouts.returns[row]),
        success=bool(rollouts.success[row]) if spec.success else None,
    )


def shown(task: Task, frames: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Values of the channels of frames with any leading shape: of the task's own, and of its
    `farm.Robust`.
    """
    values = task.show(frames)
    return {channel.name: values[channel.name] for channel in task.channels} | {
        name: frames[name] for name in CHANNELS if name in frames
    }


def whole(rollouts: Rollouts, row: int) -> dict[str, FloatArray]:
    """Measured values of one rollout: at its start, and in every frame until its end, (F + 1,
    ...).
    """
    count = len(next(iter(rollouts.frames.values()))[row])
    frames = int(rollouts.steps[row]) * (count // rollouts.actions.shape[1])
    first = {name: values[row][None] for name, values in rollouts.start.items()}
    return {
        name: np.concatenate([first[name], values[row, :frames]])
        for name, values in rollouts.frames.items()
    }


def channel_traces(task: Task, spec: TaskSpec, rollouts: Rollouts, rows: IntArray) -> AnyArray:
    """The traces of some rollouts at control rate, float32, zero after the end, (R, T, K)."""
    if not spec.trace_channels or not len(rows):
        return np.zeros((len(rows), *spec.trace_shape), dtype="<f4")
    values = flat(
        spec.trace_channels,
        shown(task, {name: frames[rows] for name, frames in rollouts.frames.items()}),
    )
    values[np.arange(task.steps) >= rollouts.steps[rows][:, None]] = 0.0
    return values


def step_shapes(spec: TaskSpec) -> dict[str, tuple[int, ...]]:
    """Shape of each part of a control step, in the order of a trace of kind `steps`."""
    shapes = {
        "observation": (spec.observation,),
        "action": (spec.action,),
        "terms": (len(spec.terms),),
    }
    return shapes | {f"channels/{channel.name}": channel.shape for channel in spec.channels}


def steps_shape(spec: TaskSpec) -> tuple[int, int]:
    """Shape of a rollout's trace of kind `steps`, (T, N)."""
    return spec.steps, sum(int(np.prod(shape)) for shape in step_shapes(spec).values())


def step_traces(task: Task, spec: TaskSpec, rollouts: Rollouts, rows: IntArray) -> AnyArray:
    """The control steps of some rollouts with observations, parts as in `step_shapes`: (R, T, N),
    zero after the end.

    Observation and action are those before a step's physics, terms and channels those after it.
    """
    channels = shown(task, {name: frames[rows] for name, frames in rollouts.frames.items()})
    if len(task.simulated) > 1:
        which = np.eye(len(task.simulated))[rollouts.which[rows]]
        channels = channels | {MODEL: np.repeat(which[:, None], task.steps, axis=1)}
    parts = [rollouts.observations[rows], rollouts.actions[rows], rollouts.terms[rows]]
    if spec.channels:
        parts.append(flat(spec.channels, channels))
    values = np.concatenate([single(part) for part in parts], axis=2)
    values[np.arange(task.steps) >= rollouts.steps[rows][:, None]] = 0.0
    return values


def _each(call: Callable[..., AnyArray], *parts: Rollouts) -> Rollouts:
    """Apply a function to every array of rollouts, or to the corresponding arrays of several."""
    arrays: dict[str, Any] = {}
    for name in Rollouts.__dataclass_fields__:
        values = [getattr(part, name) for part in parts]
        arrays[name] = (
            {key: call(*(value[key] for value in values)) for key in values[0]}
            if isinstance(values[0], Mapping)
            else call(*values)
        )
    return Rollouts(**arrays)
