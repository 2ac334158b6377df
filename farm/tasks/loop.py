"""The closed loop: observe, act, step, reward. All rollouts use it.

A rollout's numbers depend on (task, policy parameters, seed) alone: not on the other rollouts of its batch, their
order, or threads. They equal, bit for bit, those of one rollout at a time in a plain `mj_step` loop.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol

import mujoco
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, TaskError
from farm.moments import Moments
from farm.sim.channels import Camera, Channel
from farm.sim.engines import BatchEngine
from farm.sim.scene import Scene, quiet
from farm.sim.sim import Rebound, Sim
from farm.sim.trajectory import Trajectory
from farm.tasks.base import STEPS_LIMIT, Record, Task, TaskSpec, flat

RETURN_FLOOR: Final = -1e12
"""The return of a rollout that overflowed or failed: it must never look good."""

Seed = tuple[int, ...] | None
"""Seed of a rollout's random numbers; None for nominal conditions."""


class Acts(Protocol):
    """The methods that the loop needs from a policy."""

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Compute from the parameters (B, P) what stays constant during a rollout, (B, ...)."""
        ...

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d)."""
        ...


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
    """(B,) whether the simulation became unstable"""
    clamped: BoolArray
    """(B,) whether the return overflowed"""
    steps: IntArray
    """(B,) control steps until the end, including the last one"""
    terms: FloatArray
    """(B, T, K), zero after the end."""
    actions: FloatArray
    """(B, T, A), zero after the end."""
    start: Mapping[str, FloatArray]
    """Measured values at the start, and qpos, (B, ...)."""
    frames: Mapping[str, FloatArray]
    """The same in every frame, zero after the end, (B, F, ...)."""
    moments: FloatArray
    """Of its observations, (B, 1 + 2 d) as in `farm.moments`; (B, 0) if not requested."""

    @property
    def flags(self) -> BoolArray:
        """success, ended, failed, clamped, (B, 4)."""
        return np.stack([self.success, self.ended, self.failed, self.clamped], axis=1)

    @staticmethod
    def joined(parts: Sequence["Rollouts"]) -> "Rollouts":
        """Concatenate rollouts of one task."""
        return parts[0] if len(parts) == 1 else _each(lambda *values: np.concatenate(values), *parts)

    def at(self, rows: slice | IntArray) -> "Rollouts":
        """Select some rollouts."""
        return _each(lambda values: values[rows], self)


class Batch:
    """Rollouts of one task that are stepped together, independent of how actions are chosen."""

    def __init__(self, task: Task, sim: Sim, seeds: Sequence[Seed], every: int = 0) -> None:
        """Prepare their starts; rollouts with equal seeds share one.

        Args:
          task: the task; its `setup` is done.
          sim: the simulations.
          seeds: one per rollout.
          every: physics steps between two frames; 0: one frame per control step.
        """
        self.task, self.sim = task, sim
        self._parts = task.substeps // (every or task.substeps)
        self._substeps = task.substeps // self._parts
        unique = list(dict.fromkeys(seeds))
        sim.begin(len(unique))
        task.prepare(sim, [None if seed is None else np.random.default_rng(seed) for seed in unique])
        sim.start(np.array([unique.index(seed) for seed in seeds]))
        count, self.active = len(seeds), np.arange(len(seeds))
        self._start = {name: np.array(values) for name, values in self._measured().items()}  # the originals are live
        frames = (count, task.steps * self._parts)
        self._frames = {name: np.zeros((*frames, *values.shape[1:])) for name, values in self._start.items()}
        self._actions: FloatArray | None = None
        self._terms: FloatArray | None = None
        self._names: tuple[str, ...] = ()
        self._width = 0  # of an observation
        self._steps = np.full(count, task.steps)
        self._failed, self._ended, self._success = (np.zeros(count, dtype=bool) for _ in range(3))

    def observe(self) -> FloatArray:
        """Observations of the active rollouts, (n, d)."""
        x = self.task.observe(self.sim)
        self._width = self._width or (np.shape(x)[1] if np.ndim(x) > 1 else 1)
        x = _array("observe", x, (len(self.sim), self._width))
        if not np.isfinite(x).all():
            raise TaskError(f"observe is not finite before control step {self.sim.t + 1}, though the physics is fine")
        return x

    def step(self, action: FloatArray) -> None:
        """One control step of the active rollouts, with raw actions (n, A)."""
        task, sim, t = self.task, self.sim, self.sim.t
        if self._actions is None:
            self._actions = np.zeros((len(self._steps), task.steps, action.shape[1]))
        rows = self._rows()
        self._actions[rows, t] = action
        sim.control(_array("act", task.act(sim, action), (len(sim), sim.model.nu)))
        for part in range(self._parts):
            sim.step(self._substeps)
            for name, values in self._measured().items():
                self._frames[name][rows, t * self._parts + part] = values
        sim.t += 1
        failed = sim.blown_up()
        self._reward(action, t, failed)
        ended = task.ended(sim)
        ended = np.zeros(len(sim), dtype=bool) if ended is None else _array("ended", ended, (len(sim),)).astype(bool)
        self._conclude(failed, ended & ~failed, t)

    def _rows(self) -> slice | IntArray:
        """Indices of the active rollouts; a slice, which is faster, if all are active."""
        return slice(None) if len(self.active) == len(self._steps) else self.active

    def _measured(self) -> dict[str, FloatArray]:
        """The values kept of this frame, (n, ...) each."""
        count, given = len(self.sim), self.task.measure(self.sim)
        if not isinstance(given, dict):
            raise TaskError(f"measure gave a {type(given).__name__}; expected arrays by name")
        own = {name: _array(name, v, (count, *np.shape(v)[1:])) for name, v in given.items()}
        return {"qpos": self.sim.qpos, **own}

    def _reward(self, action: FloatArray, t: int, failed: BoolArray) -> None:
        """Store the reward terms of a control step, unless whole rollouts are scored."""
        if scores(self.task):
            return
        given = self.task.reward(self.sim, action)
        terms = given if isinstance(given, dict) else {"reward": given}
        if not terms:
            raise TaskError("reward gave no terms; expected an array, or arrays by name")
        values = np.stack([_array(f"reward {n}", v, (len(self.sim),)) for n, v in terms.items()], axis=1)
        if self._terms is None:
            self._names = tuple(terms)
            self._terms = np.zeros((len(self._steps), self.task.steps, len(terms)))
        if tuple(terms) != self._names:
            raise TaskError(f"reward has terms {', '.join(terms)}; the step before it had {', '.join(self._names)}")
        values[failed] = 0.0
        if not np.isfinite(values).all():
            bad = next(n for n, column in zip(terms, values.T, strict=True) if not np.isfinite(column).all())
            raise TaskError(f"reward {bad!r} is not finite in control step {t + 1}, though the physics is fine")
        self._terms[self._rows(), t] = values

    def _conclude(self, failed: BoolArray, ended: BoolArray, t: int) -> None:
        """Remove the finished rollouts; all end with the last step."""
        over = failed | ended
        last = t + 1 == self.task.steps
        if last or over.any():
            success = None if scores(self.task) else self.task.success(self.sim)
            if success is not None:
                success = _array("success", success, (len(self.sim),)).astype(bool)
                done = over | last
                self._success[self.active[done]] = (success & ~failed)[done]
        if not over.any():
            return
        self._steps[self.active[over]] = t + 1
        self._failed[self.active[failed]], self._ended[self.active[ended]] = True, True
        frames = slice(t * self._parts, (t + 1) * self._parts)
        for values in self._frames.values():
            values[self.active[failed], frames] = 0.0  # discard the numbers of unstable states
        self.active = self.active[~over]
        self.sim.keep(~over)

    @property
    def over(self) -> bool:
        """Whether all are over."""
        return self.sim.t >= self.task.steps or not len(self.active)

    def record(self) -> Record:
        """What was measured after each control step so far."""
        assert self._actions is not None
        at = slice(self._parts - 1, None, self._parts)
        frames = {name: values[:, at] for name, values in self._frames.items()}
        return Record(frames, self._start, self._actions, self._steps, self._failed)

    def rollouts(self) -> Rollouts:
        """Score the rollouts after all have ended."""
        record = self.record()
        score = self.task.score(record)
        terms, success = (self._terms, self._success) if score is None else (score.terms, score.success)
        assert terms is not None
        returns, clamped = discounted(terms, self.task.config.gamma, self.task.return_scale)
        if score is None:
            clamped = clamped | self._failed
            returns = np.where(clamped, RETURN_FLOOR, returns)
        return Rollouts(
            returns=returns, success=np.zeros(len(returns), dtype=bool) if success is None else success,
            ended=self._ended, failed=self._failed, clamped=clamped, steps=self._steps, terms=terms,
            actions=record.actions, start=self._start, frames=self._frames, moments=np.empty((len(returns), 0)),
        )  # fmt: skip


def run(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    every: int = 0,
    *,
    moments: bool = False,
) -> Rollouts:
    """Run rollouts of parameters theta (B, P) to their ends, as many at a time as the engine takes; perhaps with the
    moments of their observations."""  # noqa: D205, D209
    size, parts = sim.engine.size, []
    for first in range(0, len(theta), size):
        rows = slice(first, first + size)
        parts.append(again(lambda rows=rows: _run(task, policy, sim, theta[rows], seeds[rows], every, moments)))
    return Rollouts.joined(parts)


def _run(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    every: int,
    moments: bool,
) -> Rollouts:
    batch, seen = Batch(task, sim, seeds, every), None
    prepared = policy.prepare(theta)
    all_prepared = prepared = _array("prepare of the policy", prepared, (len(theta), *np.shape(prepared)[1:]))
    while not batch.over:
        if len(batch.active) < len(prepared):
            prepared = all_prepared[batch.active]
        x = batch.observe()
        if moments:
            seen = seen or Moments(len(seeds), x.shape[1])
            seen.add(batch.active, x)
        action = policy.act(prepared, x)
        columns = np.shape(action)[1:2] or (sim.model.nu,)
        batch.step(_array("act of the policy", action, (len(batch.active), *columns)))
    return batch.rollouts() if seen is None else replace(batch.rollouts(), moments=seen.table)


def again(doing: Callable[[], Any]) -> Any:  # noqa: ANN401  the result of `doing`
    """Start again if an output of the simulator is requested for the first time; no number depends on this."""
    while True:
        try:
            return doing()
        except Rebound:
            continue


def scores(task: Task) -> bool:
    """Whether the task scores whole rollouts."""
    return type(task).score is not Task.score


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
        clamped = ~(total >= RETURN_FLOOR)  # catches nan as well
    return np.where(clamped, RETURN_FLOOR, total), clamped


def trajectory(task: Task, spec: TaskSpec, scene: Scene, rollouts: Rollouts, row: int) -> Trajectory:
    """One rollout, frame by frame, its start first."""
    parts = next(iter(rollouts.frames.values())).shape[1] // task.steps
    steps = int(rollouts.steps[row])
    control = np.repeat(np.arange(steps), parts)
    shown = whole(rollouts, row)
    terms, actions = rollouts.terms[row], rollouts.actions[row]
    return Trajectory(
        times=np.arange(steps * parts + 1, dtype=float) * (task.period / parts),
        bodies=scene.poses(shown["qpos"]),
        actions=np.concatenate([np.zeros((1, actions.shape[1])), actions[control]]),
        terms=np.concatenate([np.zeros((1, terms.shape[1])), terms[control]]),
        channels=task.show(shown),
        value=float(rollouts.returns[row]),
        success=bool(rollouts.success[row]) if spec.success else None,
    )


def whole(rollouts: Rollouts, row: int) -> dict[str, FloatArray]:
    """Measured values of one rollout: at its start, and in every frame until its end, (F + 1, ...)."""
    count = len(next(iter(rollouts.frames.values()))[row])
    frames = int(rollouts.steps[row]) * (count // rollouts.actions.shape[1])
    first = {name: values[row][None] for name, values in rollouts.start.items()}
    return {name: np.concatenate([first[name], values[row, :frames]]) for name, values in rollouts.frames.items()}


def traces(task: Task, spec: TaskSpec, rollouts: Rollouts, rows: IntArray) -> AnyArray:
    """The traces of some rollouts at control rate, float32, zero after the end, (R, T, K)."""
    if not spec.traced or not len(rows):
        return np.zeros((len(rows), *spec.trace), dtype="<f4")
    values = flat(spec.traced, task.show({name: frames[rows] for name, frames in rollouts.frames.items()}))
    values[np.arange(task.steps) >= rollouts.steps[rows][:, None]] = 0.0
    return values


def probe(task: Task) -> TaskSpec:
    """A task's specification, found by one control step of one rollout.

    Raises:
      ConfigError: the class cannot be a task.
      TaskError: it returns invalid arrays.
    """
    quiet()
    _check_class(task)
    sim = Sim(task.engine(lambda model: BatchEngine(model, 1)))

    def look() -> tuple[Batch, int]:
        task.setup(sim)
        batch = Batch(task, sim, [None])
        x = batch.observe()
        with np.errstate(all="ignore"):
            batch.step(np.zeros((1, sim.model.nu)))
            _check_channels(task, batch._frames)
        return batch, x.shape[1]

    try:
        batch, size = again(look)
        names = batch._names or ("reward",)
        success = None if scores(task) else type(task).success is not Task.success
        return TaskSpec(
            observation=size, action=sim.model.nu, steps=task.steps, period=task.period, terms=names,
            success=bool(success), channels=task.channels,
        )  # fmt: skip
    finally:
        sim.engine.close()


def _check_class(task: Task) -> None:
    """Check a task's attributes and methods.

    Raises:
      ConfigError: names the first invalid one.
    """
    name = type(task).__name__
    for what, most in (("steps", STEPS_LIMIT), ("substeps", STEPS_LIMIT)):
        value = getattr(task, what)
        if type(value) is not int or not 1 <= value <= most:
            raise ConfigError(f"task {name}: {what} is {value!r}; expected a whole number from 1 to {most}")
    if task.camera is not None and not isinstance(task.camera, Camera):
        raise ConfigError(f"task {name}: camera is {task.camera!r}; expected a farm.Camera")
    channels: object = task.channels
    if not isinstance(channels, tuple | list) or not all(isinstance(each, Channel) for each in channels):
        raise ConfigError(f"task {name}: channels is {channels!r:.60}; expected a tuple of farm.Channel")
    for geom in (geom for channel in task.channels for geom in channel.geoms):
        if mujoco.mj_name2id(task.model, mujoco.mjtObj.mjOBJ_GEOM, geom) < 0:
            raise ConfigError(f"task {name}: there is no geometry {geom!r}, which a channel names, in the model")
    if not task.model.nu:
        raise ConfigError(f"task {name}: its model has no actuator, so that there is nothing to learn")
    for method in ("setup", "prepare", "reset", "observe", "act", "reward", "ended", "success", "measure", "score"):
        own, base = (inspect.signature(getattr(kind, method)) for kind in (type(task), Task))
        try:
            own.bind(*base.parameters)
        except TypeError:
            raise ConfigError(f"task {name}: {method}{own}; expected ({', '.join(base.parameters)})") from None


def _check_channels(task: Task, frames: Mapping[str, FloatArray]) -> None:
    """Check that the task measures its channels.

    Raises:
      TaskError: one is missing or has another shape.
    """
    missing = [c.name for c in task.channels if c.name not in frames]
    if missing and type(task).show is Task.show:
        raise TaskError(f"channel {missing[0]!r} is not measured: measure gives {', '.join(frames)}")
    shown = task.show({name: values[:, :1] for name, values in frames.items()})
    for channel in task.channels:
        _array(f"channel {channel.name!r}", shown.get(channel.name), (1, 1, *channel.shape))


def _array(name: str, values: Any, shape: tuple[int, ...]) -> AnyArray:  # noqa: ANN401  a task's result
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


def _each(call: Callable[..., AnyArray], *parts: Rollouts) -> Rollouts:
    """Apply a function to every array of rollouts, or to the corresponding arrays of several."""
    made: dict[str, Any] = {}
    for name in Rollouts.__dataclass_fields__:
        values = [getattr(part, name) for part in parts]
        made[name] = (
            {key: call(*(value[key] for value in values)) for key in values[0]}
            if isinstance(values[0], Mapping)
            else call(*values)
        )
    return Rollouts(**made)
