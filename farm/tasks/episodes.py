"""Rollouts that someone else acts in, a control step at a time, with the numbers of the farm's
loop.

A task counts its control steps for a whole batch. So rows that begin together are one `Batch` with
an engine of its own, and rows whose episodes end at different times begin anew at different times.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.sim.engines import BatchEngine
from farm.sim.interfaces import Rebound
from farm.sim.scene import quiet
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Seed


class Episodes:
    """Rows of rollouts of a task, each at its own control step.

    An episode that has ended stays as it ended until it begins again.
    """

    def __init__(self, task: Task, count: int, observation: int, terms: int) -> None:
        """Make room for `count` rows, with sizes of an observation and of the reward's terms."""
        quiet()
        self._task = task
        self._groups = list[_Group]()
        self._idle = list[Sim]()
        self._of: list[_Group | None] = [None] * count
        self._ready = False
        flags = (np.zeros(count, dtype=bool) for _ in range(4))
        self.last = Last(np.zeros((count, observation)), np.zeros((count, terms)), *flags)
        """What the last step, or the beginning, gave; written in place"""

    def begin(self, rows: IntArray, seeds: Sequence[Seed]) -> None:
        """Begin rollouts in rows (n,), of which none is on its way, from the starts for seeds.

        Raises:
          TaskError: the physics or an observation is not finite at a start.
        """
        first = 0
        while first < len(rows):
            sim = self._sim(len(rows) - first)
            part = slice(first, first + sim.engine.size)
            group = _Group(self._task, sim, rows[part], seeds[part])
            self._groups.append(group)
            for row in group.rows.tolist():
                self._of[row] = group
            group.tell(self.last, np.arange(len(group.rows)))
            first = part.stop

    def stop(self) -> None:
        """End what is on its way."""
        self._idle += [group.sim for group in self._groups]
        self._groups = []

    def step(self, action: FloatArray) -> None:
        """Take one control step of each row that is on its way, with raw actions (B, A)."""
        for group in self._groups:
            going = group.going
            group.step(action[group.rows[going]])
            group.tell(self.last, going)
        self._idle += [group.sim for group in self._groups if not len(group.going)]
        self._groups = [group for group in self._groups if len(group.going)]

    def frame(self, row: int) -> tuple[dict[str, FloatArray], int]:
        """What was last measured of a row that has begun, by name; and which model it has."""
        group = self._of[row]
        assert group is not None
        return group.frame(row)

    def close(self) -> None:
        """Release the engines."""
        self.stop()
        for sim in self._idle:
            sim.engine.close()
        self._idle = []

    def _sim(self, count: int) -> Sim:
        """Simulations of at least this number of rows, or as many as the task's engine takes."""
        fitting = [sim for sim in self._idle if sim.engine.size >= count]
        if fitting:
            sim = min(fitting, key=lambda each: each.engine.size)
            self._idle.remove(sim)
            return sim
        sim = Sim(self._task.engine(lambda model: BatchEngine(model, count)))
        if not self._ready:
            again(lambda: self._task.setup(sim))
            self._ready = True
        return sim


@dataclass(frozen=True)
class Last:
    """Results of a control step of B rows."""

    observation: FloatArray
    """(B, d); of an episode that failed the last one that is finite"""
    terms: FloatArray
    """Reward terms of the step, (B, K)"""
    terminated: BoolArray
    """Whether the task ended the episode, or it failed, (B,)"""
    truncated: BoolArray
    """Whether the episode is over for any other reason, such as its length, (B,)"""
    failed: BoolArray
    """(B,)"""
    success: BoolArray
    """Whether the episode ended with success, (B,)"""


class _Watched(Batch):
    """Rollouts of which the last observations are kept, also those of rollouts that end."""

    seen: FloatArray | None = None
    """(B, d)"""

    def look(self) -> None:
        """Observe; a rollout whose observation is not finite fails, except after the last step.

        The farm's loop does not observe there.
        """
        if self.acted and self.over:
            self._glance(np.ones(len(self.sim), dtype=bool))
            return
        x = self.observe()
        if self.seen is None:
            self.seen = np.zeros((len(self.which), x.shape[1]))
        self.seen[self.rows] = x

    def _conclude(self, failed: BoolArray, ended: BoolArray, t: int) -> None:
        self._glance(ended)
        super()._conclude(failed, ended, t)

    def _glance(self, rows: BoolArray) -> None:
        """Observe rollouts (n,) that end here, if that is finite."""
        if self.seen is None or not rows.any():
            return
        with self.sim.only(rows):
            x = np.array(self._seen(self.active[rows]))
        sound = np.isfinite(x).all(axis=1)
        self.seen[self.active[rows][sound]] = x[sound]

    def tell(self, last: Last, rows: IntArray, at: IntArray) -> None:
        """Say in `rows` what the last step gave those at `at`, (n,) each."""
        over = self.sim.t >= self.task.steps
        t = self.sim.t - 1
        done = np.ones(len(self.which), dtype=bool)
        done[self.active] = over
        assert self.seen is not None
        last.observation[rows] = self.seen[at]
        last.failed[rows] = self._failed[at]
        last.terms[rows] = 0.0 if self.terms is None or t < 0 else self.terms[at, t]
        last.terminated[rows] = (self._ended | self._failed)[at]
        last.truncated[rows] = done[at] & ~last.terminated[rows]
        last.success[rows] = (done & self._success)[at]

    def frame(self, at: int, steps: int) -> tuple[dict[str, FloatArray], int]:
        """What was measured of one after so many control steps, or its last; and its model."""
        t = min(steps, int(self._steps[at])) - int(self._failed[at])  # where it failed nothing is
        now = {name: values[at, t - 1] for name, values in self.frames.items()}
        start = {name: values[at] for name, values in self.start.items()}
        return now if t > 0 else start, int(self.which[at])


class _Group:
    """Rows that began together."""

    def __init__(self, task: Task, sim: Sim, rows: IntArray, seeds: Sequence[Seed]) -> None:
        self._task = task
        self.sim = sim
        self._seeds = seeds
        self.rows = rows
        """Which of the rows these are, (n,)"""
        self._done: list[FloatArray] = []  # actions so far
        self._batch: _Watched = again(self._played)
        if len(self._batch.active) < len(rows):
            raise self._batch.trouble.errors[0]

    @property
    def going(self) -> IntArray:
        """Rollouts that are not over, by their place in `rows`."""
        return self.rows[:0] if self._batch.over else self._batch.active

    def step(self, action: FloatArray) -> None:
        """Take one control step of the rollouts that are not over."""
        self._done.append(np.array(action))
        try:
            self._batch.step(self._done[-1])
            self._batch.look()
        except Rebound:  # an output is read for the first time: again from the start, with it
            self._batch = again(self._played)

    def _played(self) -> _Watched:
        batch = _Watched(self._task, self.sim, self._seeds, tolerant=not self._task.config.strict)
        batch.look()
        for action in self._done:
            batch.step(action)
            batch.look()
        return batch

    def tell(self, last: Last, at: IntArray) -> None:
        """Say what the last step gave those at these places in `rows`."""
        self._batch.tell(last, self.rows[at], at)

    def frame(self, row: int) -> tuple[dict[str, FloatArray], int]:
        """What was last measured of a row, by name; and which model it has."""
        return self._batch.frame(int(np.flatnonzero(self.rows == row)[0]), len(self._done))
