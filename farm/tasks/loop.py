"""The closed loop: observe, act, step, reward. All rollouts use it.

A rollout's numbers depend on (task, policy parameters, seed) alone: not on the other rollouts of
its batch, their order, or threads. They equal, bit for bit, those of one rollout at a time in a
plain `mj_step` loop.
"""

import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeAlias, TypeVar

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray, shaped
from farm.errors import TaskError, UnstableError
from farm.moments import Moments
from farm.returns import RETURN_FLOOR
from farm.sim.complaints import KINDS
from farm.sim.interfaces import Rebound
from farm.sim.sim import Sim, complaint, unwritable, warned
from farm.sim.trajectory import single
from farm.tasks import disturbances
from farm.tasks.base import Record, Score, Task, TaskSpec
from farm.tasks.rollouts import Rollouts, Seed, discounted, drawn, measured
from farm.tasks.trouble import NOT_OF_TASK, Trouble

_OF_THE_SIMULATION = frozenset(("qpos", "mocap", *disturbances.CHANNELS))

P = ParamSpec("P")
T = TypeVar("T")


class Acts(Protocol):
    """The methods that rollouts need from a policy.

    It may have `memory` and `scale`, as `farm.Policy`.
    """

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Compute from the parameters (B, P) what stays constant during a rollout, (B, ...)."""
        ...

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d)."""
        ...


class Acting:
    """A policy in B rollouts.

    It keeps their memories, so each rollout must act once in each of its control steps.
    """

    def __init__(self, policy: Acts, theta: FloatArray) -> None:
        """Prepare parameters (B, P), in the search's units; all rollouts are at their starts.

        Raises:
          TaskError: `prepare` gives something else than one array with a row per rollout.
        """
        scale: FloatArray | None = getattr(policy, "scale", None)
        prepared: object = policy.prepare(theta if scale is None else scale * theta)
        if not isinstance(prepared, np.ndarray):
            raise TaskError(
                f"prepare of the policy gave a {type(prepared).__name__}; expected one array, with"
                " a row per rollout: join what act needs, and split it there"
            )
        self._policy: Any = policy
        self._all = self._prepared = shaped(
            "prepare of the policy", prepared, (len(theta), *prepared.shape[1:])
        )
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
                f"act of the policy gave a {type(result).__name__}; expected (action, memory), as"
                " the policy has memory"
            )
        action, after = result
        self._memory[rows] = shaped(
            "memory from act of the policy", after, (len(rows), self._memory.shape[1])
        )
        return action

    def forget(self, rows: IntArray) -> None:
        """Let rollouts (n,) remember what they did at their starts."""
        if self._memory is not None:
            self._memory[rows] = self._first


def _explained(call: Callable[P, T]) -> Callable[P, T]:
    """Let a task's write to a read-only array be a TaskError of one line; numpy names neither
    array nor remedy.
    """

    @wraps(call)
    def method(*values: P.args, **keywords: P.kwargs) -> T:
        try:
            return call(*values, **keywords)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}, line {last.lineno}"
            raise TaskError(
                f"{where}, cannot write {last.line or 'there'}: {unwritable(last.line or '')}"
            ) from error

    return method


class Batch:
    """Rollouts of one task that are stepped together, independent of how actions are chosen."""

    @_explained
    def __init__(
        self, task: Task, sim: Sim, seeds: Sequence[Seed], every: int = 0, *, tolerant: bool = False
    ) -> None:
        """Prepare their starts; rollouts with equal seeds share one.

        Args:
          task: the task; its `setup` is done.
          sim: the simulations.
          seeds: one per rollout.
          every: physics steps between two frames; 0: one frame per control step.
          tolerant: whether a rollout whose observation or reward is not finite fails alone;
              otherwise that is an error.
        """
        self._tolerant = tolerant
        self.task, self.sim = task, sim
        self._parts = task.substeps // (every or task.substeps)
        self._substeps = task.substeps // self._parts
        unique = list(dict.fromkeys(seeds))
        robust = disturbances.of(task)
        self._disturbed = None if robust is None else disturbances.Disturbances(robust, task)
        rngs = [None if seed is None else np.random.default_rng(seed) for seed in unique]
        sim.begin(len(unique), drawn(task, rngs) if len(sim.models) > 1 else None, unique)
        if task.space:
            task.space.begin(sim)
        task.prepare(sim, rngs)
        if self._disturbed:
            self._disturbed.prepare(sim)
        sim.start(np.array([unique.index(seed) for seed in seeds]))
        if self._disturbed:
            self._disturbed.start(sim)
        self.which = sim.which
        """Which of the task's models each has, (B,)"""
        count, self.active = len(seeds), np.arange(len(seeds))
        self.rows: slice | IntArray = slice(None)
        """Indices of the active rollouts; a slice, which is faster, while all are active"""
        # The originals are live
        self.start = {name: np.array(values) for name, values in self._measured().items()}
        """Measured values at the starts, by name, (B, ...)"""
        frames = (count, task.steps * self._parts)
        self.frames = {
            name: np.zeros((*frames, *values.shape[1:])) for name, values in self.start.items()
        }
        """Measured values so far, by name, (B, F, ...)"""
        self._actions: FloatArray | None = None
        self.terms: FloatArray | None = None
        """Reward terms so far, (B, T, K); None before the first step, or if the task scores whole
        rollouts
        """
        self.names: tuple[str, ...] = ()
        """Names of the terms"""
        self._width = 0  # of an observation
        self._errors: list[Exception] = []
        self._warned = warned(sim.engine, np.arange(count))  # before the first step
        self._steps = np.full(count, task.steps)
        self._failed, self._ended, self._success = (np.zeros(count, dtype=bool) for _ in range(3))

    @_explained
    def observe(self) -> FloatArray:
        """Observations of the active rollouts, (n, d)."""
        x = self._seen(self.active)
        if np.isfinite(x).all():
            return x
        bad: BoolArray = np.logical_not(np.isfinite(x).all(axis=1))
        where = f"before control step {self.sim.t + 1}"
        if (self.sim.blown_up() >= bad).all():
            why = complaint(self.sim.engine) or "look at what reset writes"
            self._fail(UnstableError(f"the physics is unstable {where}: {why}"))
        else:
            self._fail(TaskError(f"observe is not finite {where}, though the physics is fine"))
        self._conclude(bad, np.zeros(len(bad), dtype=bool), self.sim.t)
        return x[~bad]

    def _seen(self, rows: IntArray) -> FloatArray:
        """What the policy sees of rollouts (n,): the observation with its errors, and what the
        action space adds.
        """
        x = self.task.observe(self.sim)
        self._width = self._width or (np.shape(x)[1] if np.ndim(x) > 1 else 1)
        x = shaped("observe", x, (len(self.sim), self._width))
        if self._disturbed:
            x = self._disturbed.observe(self.sim, x, rows)
        return x if self.task.space is None else self.task.space.see(self.sim, x)

    def _fail(self, error: TaskError) -> None:
        """Note why some rollouts fail; raise it if none may fail alone."""
        if not self._tolerant:
            raise error
        self._errors.append(error)

    @property
    def trouble(self) -> Trouble:
        """What went wrong so far."""
        mask = warned(self.sim.engine, np.arange(len(self._steps))) > self._warned
        counts = zip(KINDS, np.count_nonzero(mask, axis=0).tolist(), strict=True)
        return Trouble(self._errors, Counter({kind: count for kind, count in counts if count}))

    @_explained
    def step(self, action: FloatArray) -> None:
        """One control step of the active rollouts, with raw actions (n, A)."""
        task, sim, t = self.task, self.sim, self.sim.t
        if self._actions is None:
            self._actions = np.zeros((len(self._steps), task.steps, action.shape[1]))
        self._actions[self.rows, t] = action
        late = self._disturbed.late(action, t, self.active) if self._disturbed else action
        with sim.writing() as states:
            if self._disturbed:
                self._disturbed.release(sim, self.active)
            # An environment's actions need not be the model's controls
            width = sim.engine.field("ctrl").shape[1]
            controls = shaped("act", task.act(sim, late), (len(sim), width))
            sim.detach()
            sim.control(controls)
            if self._disturbed:
                self._disturbed.press(sim, self.active)
        sim.write(states)
        for part in range(self._parts):
            sim.step(self._substeps)
            for name, values in self._measured().items():
                self.frames[name][self.rows, t * self._parts + part] = values
        sim.t += 1
        if words := complaint(sim.engine):
            self._errors.append(UnstableError(f"MuJoCo cannot go on: {words}"))
        failed = self._reward(action, t, sim.blown_up())
        ended = task.ended(sim)
        if ended is None:
            ended = np.zeros(len(sim), dtype=bool)
        else:
            failed, ended = self._decided("ended", ended, t, failed)
        self._conclude(failed, ended & ~failed, t)

    def _measured(self) -> dict[str, FloatArray]:
        """The values kept of this frame, (n, ...) each."""
        count, frame = len(self.sim), self.task.measure(self.sim)
        if not isinstance(frame, dict):
            raise TaskError(f"measure gave a {type(frame).__name__}; expected arrays by name")
        for name in _OF_THE_SIMULATION.intersection(frame):
            raise TaskError(f"measure gave {name!r}, which is the simulation's: name it otherwise")
        arrays = {name: shaped(name, v, (count, *np.shape(v)[1:])) for name, v in frame.items()}
        conditions = self._disturbed.measured(self.sim, self.active) if self._disturbed else {}
        return {"qpos": self.sim.qpos, **self._mocap(), **arrays, **conditions}

    def _mocap(self) -> dict[str, FloatArray]:
        """Poses of mocap bodies (n, nmocap, 7), if there are any: with qpos, where everything
        is.
        """
        if not self.sim.model.nmocap:
            return {}
        return {"mocap": np.concatenate([self.sim.mocap_pos, self.sim.mocap_quat], axis=2)}

    def _reward(self, action: FloatArray, t: int, failed: BoolArray) -> BoolArray:
        """Store the reward terms of a control step, unless whole rollouts are scored; return
        which rollouts fail.
        """
        if scores(self.task):
            return failed
        reward = self.task.reward(self.sim, action)
        terms = reward if isinstance(reward, dict) else {"reward": reward}
        if not terms:
            raise TaskError("reward gave no terms; expected an array, or arrays by name")
        values = np.empty((len(self.sim), len(terms)))
        for column, (name, term) in enumerate(terms.items()):
            if not isinstance(name, str):
                raise TaskError(f"reward names a term {name!r:.40}; expected texts as names")
            values[:, column] = shaped(f"reward {name}", term, (len(self.sim),))
        if self.terms is None:
            self.names = tuple(terms)
            self.terms = np.zeros((len(self._steps), self.task.steps, len(terms)))
        if tuple(terms) != self.names:
            raise TaskError(
                f"reward has terms {', '.join(terms)}; the step before it had"
                f" {', '.join(self.names)}"
            )
        values[failed] = 0.0
        if not np.isfinite(values).all():
            bad = next(
                n
                for n, column in zip(terms, values.T, strict=True)
                if not np.isfinite(column).all()
            )
            self._fail(
                TaskError(
                    f"reward {bad!r} is not finite in control step {t + 1}, though the physics is"
                    " fine"
                )
            )
            failed = failed | ~np.isfinite(values).all(axis=1)
            values[failed] = 0.0
        self.terms[self.rows, t] = values
        return failed

    def _decided(
        self, what: str, values: object, t: int, failed: BoolArray
    ) -> tuple[BoolArray, BoolArray]:
        """What a task decides on each rollout (n,), as truths, behind the rollouts that fail: a
        number that is not finite decides nothing.
        """
        array = shaped(what, values, (len(self.sim),))
        unknown = ~np.isfinite(array) & ~failed
        if unknown.any():
            self._fail(
                TaskError(
                    f"{what} is not finite in control step {t + 1}, though the physics is fine"
                )
            )
        return failed | unknown, array.astype(bool) & ~unknown

    def _conclude(self, failed: BoolArray, ended: BoolArray, t: int) -> None:
        """Remove the finished rollouts; all end with the last step."""
        over, last = failed | ended, t + 1 == self.task.steps
        if over.any() or last:
            success = None if scores(self.task) else self.task.success(self.sim)
            if success is not None:
                done = over | last
                success = shaped("success", success, (len(self.sim),))
                success = np.where(done, success, 0.0)  # it says nothing of those that go on
                failed, success = self._decided("success", success, t, failed)
                over, ended = failed | ended, ended & ~failed
                self._success[self.active[done]] = (success & ~failed)[done]
        if not over.any():
            return
        self._steps[self.active[over]] = t + 1
        self._failed[self.active[failed]], self._ended[self.active[ended]] = True, True
        frames = slice(t * self._parts, (t + 1) * self._parts)
        for values in self.frames.values():
            values[self.active[failed], frames] = 0.0  # discard the numbers of unstable states
        if self.terms is not None:
            self.terms[self.active[failed], t] = 0.0
        self.active = self.rows = self.active[~over]
        if self._disturbed:
            self._disturbed.keep(~over)
        self.sim.keep(~over)

    @property
    def over(self) -> bool:
        """Whether all rollouts are over."""
        return self.sim.t >= self.task.steps or not len(self.active)

    def raised(self, error: Exception, spec: TaskSpec) -> Rollouts:
        """The batch's only rollout, in whose control step the task raised an error: it failed
        there.
        """
        self._errors.append(error)
        last = min(self.sim.t, self.task.steps - 1)
        self._steps[:], self._failed[:] = last + 1, True
        for values in self.frames.values():
            values[:, last * self._parts :] = 0.0
        return self.lost(spec)

    @property
    def acted(self) -> bool:
        """Whether some rollout did not fail before its first step."""
        return self._actions is not None

    def lost(self, spec: TaskSpec) -> Rollouts:
        """The rollouts, all of which failed, as their task cannot score them."""
        count, steps = len(self._steps), self.task.steps
        if self._actions is None:
            self._actions = np.zeros((count, steps, spec.action))
        if self.terms is None:
            self.terms = np.zeros((count, steps, len(spec.terms)))
        low = np.tile([each.low for each in self.task.measures], (count, 1)).astype(float)
        success = np.zeros(count, dtype=bool)
        return self._rollouts(np.full(count, RETURN_FLOOR), self.terms, success, self._failed, low)

    def record(self) -> Record:
        """What was measured after each control step so far."""
        assert self._actions is not None
        at = slice(self._parts - 1, None, self._parts)
        frames = {name: values[:, at] for name, values in self.frames.items()}
        return Record(frames, self.start, self._actions, self._steps, self._failed, self.which)

    def rollouts(self) -> Rollouts:
        """Score the rollouts after all have ended; some have acted."""
        record = self.record()
        score = self.task.score(record)
        if score is not None and not isinstance(score, Score):
            raise TaskError(f"score gave a {type(score).__name__}; expected a farm.Score, or None")
        terms, success = self.terms, self._success
        if score is not None:
            count = len(self._steps)
            columns = np.shape(score.terms)[2:3] or (1,)
            terms = shaped("terms of score", score.terms, (count, self.task.steps, *columns))
            success = score.success
            if success is not None:
                success = shaped("success of score", success, (count,))
                success = np.isfinite(success) & success.astype(bool)
        assert terms is not None
        returns, clamped = discounted(terms, self.task.config.gamma, self.task.return_scale)
        if score is None:
            clamped = clamped | self._failed
            returns = np.where(clamped, RETURN_FLOOR, returns)
        success = np.zeros(len(returns), dtype=bool) if success is None else success
        return self._rollouts(returns, terms, success, clamped, measured(self.task, record))

    def _rollouts(
        self,
        returns: FloatArray,
        terms: FloatArray,
        success: BoolArray,
        clamped: BoolArray,
        measures: FloatArray,
    ) -> Rollouts:
        assert self._actions is not None
        return Rollouts(
            returns=returns,
            success=success,
            ended=self._ended,
            failed=self._failed,
            clamped=clamped,
            steps=self._steps,
            terms=terms,
            actions=self._actions,
            start=self.start,
            frames=self.frames,
            which=self.which,
            measures=measures,
            moments=np.empty((len(returns), 0)),
            observations=np.empty((len(returns), 0), "<f4"),
        )


Advance: TypeAlias = Callable[[int], None]
"""Called with the number of rollouts that are done since the last call."""


def unseen(count: int) -> None:
    """Show nobody that rollouts are done."""


@dataclass(frozen=True)
class Kept:
    """Choice of what is kept of rollouts beside their results."""

    every: int = 0
    """Physics steps between two frames; 0: one frame per control step."""
    moments: bool = False
    """The moments of their observations."""
    observations: bool = False
    """The observations themselves."""


def run(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    spec: TaskSpec,
    kept: Kept = Kept(),
    advance: Advance = unseen,
) -> tuple[Rollouts, Trouble]:
    """Run rollouts of parameters theta (B, P) to their ends, as many at a time as the engine takes;
    `advance` is told how many are done each time.

    A rollout in which the task raises an error counts as failed, if the task is not strict: it is
    found by halving the batch, which changes no number of the others. Errors that may be this
    machine's are raised (`NOT_OF_TASK`).

    Returns:
      the rollouts, and what went wrong in them.
    """
    rollouts, trouble = [], Trouble()
    for first in range(0, len(theta), sim.engine.size):
        rows = slice(first, first + sim.engine.size)
        part, its = _tolerant(task, policy, sim, theta[rows], seeds[rows], spec, kept)
        advance(len(seeds[rows]))
        rollouts.append(part)
        trouble.add(its)
    return Rollouts.joined(rollouts), trouble


def _tolerant(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    spec: TaskSpec,
    extras: Kept,
) -> tuple[Rollouts, Trouble]:
    try:
        return _run(task, policy, sim, theta, seeds, spec, extras)
    except NOT_OF_TASK:
        raise
    except Exception:
        if task.config.strict or len(seeds) == 1:
            raise
    half = len(seeds) // 2
    first, trouble = _tolerant(task, policy, sim, theta[:half], seeds[:half], spec, extras)
    second, its = _tolerant(task, policy, sim, theta[half:], seeds[half:], spec, extras)
    trouble.add(its)
    return Rollouts.joined([first, second]), trouble


def _run(
    task: Task,
    policy: Acts,
    sim: Sim,
    theta: FloatArray,
    seeds: Sequence[Seed],
    spec: TaskSpec,
    extras: Kept,
) -> tuple[Rollouts, Trouble]:
    """Run one batch.

    If it is a single rollout of a task that is not strict, an error of the task's ends that.
    """
    alone = len(seeds) == 1 and not task.config.strict

    def attempt() -> tuple[Rollouts, Trouble]:
        sums = Moments(len(seeds), spec.observation if extras.moments else 0)
        steps = task.steps if extras.observations else 0
        history = np.zeros((len(seeds), steps, spec.observation), "<f4")
        batch: Batch | None = None
        try:
            batch = Batch(task, sim, seeds, extras.every, tolerant=not task.config.strict)
            _act(batch, Acting(policy, theta), sums if extras.moments else None, history)
            rollouts = batch.rollouts() if batch.acted else batch.lost(spec)
            if rollouts.terms.shape[2] != len(spec.terms):
                raise TaskError(
                    f"score gave {rollouts.terms.shape[2]} terms; expected {len(spec.terms)}, as"
                    " for the first control step"
                )
        except (*NOT_OF_TASK, Rebound):
            raise
        except Exception as error:
            if not alone or (batch is None and seeds[0] is None):
                raise
            # A rollout that has no start of its own has failed at the nominal one.
            batch = batch or Batch(task, sim, [None], extras.every)
            rollouts = batch.raised(error, spec)
        observations = history if extras.observations else rollouts.observations
        moments = sums.table if extras.moments else rollouts.moments
        return replace(rollouts, moments=moments, observations=observations), batch.trouble

    done: tuple[Rollouts, Trouble] = again(attempt)
    return done


def _act(batch: Batch, acting: Acting, sums: Moments | None, history: AnyArray) -> None:
    """Let a policy act until all rollouts are over; moments and observations (B, T, d) are added
    up, if wanted.
    """
    sim = batch.sim
    while not batch.over:
        x = batch.observe()
        if batch.over:
            return
        if sums is not None:
            sums.add(batch.rows, x)
        if history.shape[1]:
            history[batch.rows, sim.t] = single(x)
        action = acting.act(x, batch.active)
        size = batch.task.action_size or (*np.shape(action)[1:2], 1)[0]
        batch.step(shaped("act of the policy", action, (len(batch.active), size)))


def again(doing: Callable[[], Any]) -> Any:  # noqa: ANN401  the result of `doing`
    """Start again if an output of the simulator is requested for the first time; no number
    depends on this.
    """
    while True:
        try:
            return doing()
        except Rebound:
            continue


def scores(task: Task) -> bool:
    """Whether the task scores whole rollouts."""
    return type(task).score is not Task.score
