"""The closed loop: observe, act, step, reward. All rollouts use it.

A rollout's numbers depend on (task, policy parameters, seed) alone: not on the other rollouts of its batch, their
order, or threads. They equal, bit for bit, those of one rollout at a time in a plain `mj_step` loop.
"""

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import TaskError
from farm.moments import Moments
from farm.sim.channels import flat
from farm.sim.interfaces import Rebound
from farm.sim.scene import Scene
from farm.sim.sim import Sim, unwritable
from farm.sim.trajectory import Trajectory, single
from farm.tasks.acting import Acting, Acts, shaped
from farm.tasks.base import Record, Task, TaskSpec
from farm.tasks.outcomes import drawn, measured

P = ParamSpec("P")
T = TypeVar("T")

RETURN_FLOOR: Final = -1e12
"""The return of a rollout that overflowed or failed: it must never look good."""

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
    """Measured values at the start, qpos and (if there are mocap bodies) mocap, (B, ...)."""
    frames: Mapping[str, FloatArray]
    """The same in every frame, zero after the end, (B, F, ...)."""
    which: IntArray
    """(B,) index of each one's model among the task's"""
    measures: FloatArray
    """Of the task's measures, in their order (B, M)"""
    moments: FloatArray
    """Of its observations, (B, 1 + 2 d) as in `farm.moments`; (B, 0) if not requested."""
    observations: AnyArray
    """Before each control step, zero after the end, (B, T, d) in single precision; (B, 0) if not requested."""

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


def _explained(call: Callable[P, T]) -> Callable[P, T]:
    """Let a task's write to a read-only array be a TaskError of one line; numpy names neither array nor remedy."""

    @wraps(call)
    def method(*values: P.args, **keywords: P.kwargs) -> T:
        try:
            return call(*values, **keywords)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            raise TaskError(f"{where}, cannot write {last.line or 'there'}: {unwritable(last.line or '')}") from error

    return method


class Batch:
    """Rollouts of one task that are stepped together, independent of how actions are chosen."""

    @_explained
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
        rngs = [None if seed is None else np.random.default_rng(seed) for seed in unique]
        sim.begin(len(unique), drawn(task, rngs) if len(sim.models) > 1 else None)
        task.prepare(sim, rngs)
        sim.start(np.array([unique.index(seed) for seed in seeds]))
        self.which = sim.which
        """Which of the task's models each has, (B,)"""
        count, self.active = len(seeds), np.arange(len(seeds))
        self.rows: slice | IntArray = slice(None)
        """Indices of the active rollouts; a slice, which is faster, while all are active"""
        self.start = {name: np.array(values) for name, values in self._measured().items()}  # the originals are live
        """Measured values at the starts, by name, (B, ...)"""
        frames = (count, task.steps * self._parts)
        self.frames = {name: np.zeros((*frames, *values.shape[1:])) for name, values in self.start.items()}
        """Measured values so far, by name, (B, F, ...)"""
        self._actions: FloatArray | None = None
        self.terms: FloatArray | None = None
        """Reward terms so far, (B, T, K); None before the first step, or if the task scores whole rollouts"""
        self.names: tuple[str, ...] = ()
        """Names of the terms"""
        self._width = 0  # of an observation
        self._steps = np.full(count, task.steps)
        self._failed, self._ended, self._success = (np.zeros(count, dtype=bool) for _ in range(3))

    @_explained
    def observe(self) -> FloatArray:
        """Observations of the active rollouts, (n, d)."""
        x = self.task.observe(self.sim)
        self._width = self._width or (np.shape(x)[1] if np.ndim(x) > 1 else 1)
        x = shaped("observe", x, (len(self.sim), self._width))
        if not np.isfinite(x).all():
            raise TaskError(f"observe is not finite before control step {self.sim.t + 1}, though the physics is fine")
        return x

    @_explained
    def step(self, action: FloatArray) -> None:
        """One control step of the active rollouts, with raw actions (n, A)."""
        task, sim, t = self.task, self.sim, self.sim.t
        if self._actions is None:
            self._actions = np.zeros((len(self._steps), task.steps, action.shape[1]))
        self._actions[self.rows, t] = action
        with sim.writing() as states:
            width = sim.engine.field("ctrl").shape[1]  # an environment's actions need not be the model's controls
            sim.control(shaped("act", task.act(sim, action), (len(sim), width)))
        sim.write(states)
        for part in range(self._parts):
            sim.step(self._substeps)
            for name, values in self._measured().items():
                self.frames[name][self.rows, t * self._parts + part] = values
        sim.t += 1
        failed = sim.blown_up()
        self._reward(action, t, failed)
        ends = task.ended(sim)
        ends = np.zeros(len(sim), dtype=bool) if ends is None else shaped("ended", ends, (len(sim),)).astype(bool)
        self._conclude(failed, ends & ~failed, t)

    def _measured(self) -> dict[str, FloatArray]:
        """The values kept of this frame, (n, ...) each."""
        count, frame = len(self.sim), self.task.measure(self.sim)
        if not isinstance(frame, dict):
            raise TaskError(f"measure gave a {type(frame).__name__}; expected arrays by name")
        arrays = {name: shaped(name, v, (count, *np.shape(v)[1:])) for name, v in frame.items()}
        return {"qpos": self.sim.qpos, **self._mocap(), **arrays}

    def _mocap(self) -> dict[str, FloatArray]:
        """Poses of mocap bodies (n, nmocap, 7), if there are any: with qpos, where everything is."""
        if not self.sim.model.nmocap:
            return {}
        return {"mocap": np.concatenate([self.sim.mocap_pos, self.sim.mocap_quat], axis=2)}

    def _reward(self, action: FloatArray, t: int, failed: BoolArray) -> None:
        """Store the reward terms of a control step, unless whole rollouts are scored."""
        if scores(self.task):
            return
        reward = self.task.reward(self.sim, action)
        terms = reward if isinstance(reward, dict) else {"reward": reward}
        if not terms:
            raise TaskError("reward gave no terms; expected an array, or arrays by name")
        values = np.empty((len(self.sim), len(terms)))
        for column, (name, term) in enumerate(terms.items()):
            values[:, column] = shaped(f"reward {name}", term, (len(self.sim),))
        if self.terms is None:
            self.names = tuple(terms)
            self.terms = np.zeros((len(self._steps), self.task.steps, len(terms)))
        if tuple(terms) != self.names:
            raise TaskError(f"reward has terms {', '.join(terms)}; the step before it had {', '.join(self.names)}")
        values[failed] = 0.0
        if not np.isfinite(values).all():
            bad = next(n for n, column in zip(terms, values.T, strict=True) if not np.isfinite(column).all())
            raise TaskError(f"reward {bad!r} is not finite in control step {t + 1}, though the physics is fine")
        self.terms[self.rows, t] = values

    def _conclude(self, failed: BoolArray, ends: BoolArray, t: int) -> None:
        """Remove the finished rollouts; all end with the last step."""
        over, last = failed | ends, t + 1 == self.task.steps
        any_over = bool(over.any())
        if any_over or last:
            success = None if scores(self.task) else self.task.success(self.sim)
            if success is not None:
                success = shaped("success", success, (len(self.sim),)).astype(bool)
                done = over | last
                self._success[self.active[done]] = (success & ~failed)[done]
        if not any_over:
            return
        self._steps[self.active[over]] = t + 1
        self._failed[self.active[failed]], self._ended[self.active[ends]] = True, True
        frames = slice(t * self._parts, (t + 1) * self._parts)
        for values in self.frames.values():
            values[self.active[failed], frames] = 0.0  # discard the numbers of unstable states
        self.active = self.rows = self.active[~over]
        self.sim.keep(~over)

    @property
    def over(self) -> bool:
        """Whether all are over."""
        return self.sim.t >= self.task.steps or not len(self.active)

    def record(self) -> Record:
        """What was measured after each control step so far."""
        assert self._actions is not None
        at = slice(self._parts - 1, None, self._parts)
        frames = {name: values[:, at] for name, values in self.frames.items()}
        return Record(frames, self.start, self._actions, self._steps, self._failed, self.which)

    def rollouts(self) -> Rollouts:
        """Score the rollouts after all have ended."""
        record = self.record()
        score = self.task.score(record)
        terms, success = (self.terms, self._success) if score is None else (score.terms, score.success)
        assert terms is not None
        returns, clamped = discounted(terms, self.task.config.gamma, self.task.return_scale)
        if score is None:
            clamped = clamped | self._failed
            returns = np.where(clamped, RETURN_FLOOR, returns)
        return Rollouts(
            returns=returns, success=np.zeros(len(returns), dtype=bool) if success is None else success,
            ended=self._ended, failed=self._failed, clamped=clamped, steps=self._steps, terms=terms,
            actions=record.actions, start=self.start, frames=self.frames, which=self.which,
            measures=measured(self.task, record), moments=np.empty((len(returns), 0)),
            observations=np.empty((len(returns), 0), "<f4"),
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
    observed: bool = False,
) -> Rollouts:
    """Run rollouts of parameters theta (B, P) to their ends, as many at a time as the engine takes; perhaps with the
    moments of their observations, or with these themselves."""  # noqa: D205, D209
    size, parts = sim.engine.size, []
    for first in range(0, len(theta), size):
        rows = slice(first, first + size)
        parts.append(
            again(lambda rows=rows: _run(task, policy, sim, theta[rows], seeds[rows], every, moments, observed))
        )
    return Rollouts.joined(parts)


def _run(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    every: int,
    moments: bool,
    observed: bool,
) -> Rollouts:
    batch, sums = Batch(task, sim, seeds, every), None
    history: AnyArray = np.empty((len(seeds), 0), "<f4")
    acting = Acting(policy, theta)
    while not batch.over:
        x = batch.observe()
        if moments:
            sums = sums or Moments(len(seeds), x.shape[1])
            sums.add(batch.rows, x)
        if observed:
            history = history if history.ndim > 2 else np.zeros((len(seeds), task.steps, x.shape[1]), "<f4")
            history[batch.rows, sim.t] = single(x)
        action = acting.act(x, batch.active)
        columns = np.shape(action)[1:2] or (sim.model.nu,)
        batch.step(shaped("act of the policy", action, (len(batch.active), *columns)))
    table = np.empty((len(seeds), 0)) if sums is None else sums.table
    return replace(batch.rollouts(), moments=table, observations=history)


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
    frames = whole(rollouts, row)
    terms, actions, which = rollouts.terms[row], rollouts.actions[row], int(rollouts.which[row])
    return Trajectory.of(
        times=np.arange(steps * parts + 1, dtype=float) * (task.period / parts),
        bodies=scene.each[which].poses(frames["qpos"], frames.get("mocap")),
        actions=np.concatenate([np.zeros((1, actions.shape[1])), actions[control]]),
        terms=np.concatenate([np.zeros((1, terms.shape[1])), terms[control]]),
        channels=task.show(frames) | scene.said(which, len(frames["qpos"])),
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
    if not spec.trace_channels or not len(rows):
        return np.zeros((len(rows), *spec.trace_shape), dtype="<f4")
    values = flat(spec.trace_channels, task.show({name: frames[rows] for name, frames in rollouts.frames.items()}))
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
