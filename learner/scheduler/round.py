"""A round's jobs, and what came of them: one array of each kind over all rollouts, in the jobs' order. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.net.work import Jobs, Results, WireTrajectory, traced
from farm.sim.trajectory import Trajectory


class RoundResults:
    """Jobs 0..n-1 and their results, S rollouts in all; a result is written where it belongs, whenever it comes."""

    def __init__(
        self,
        jobs: Jobs,
        traces: str,
        trace: tuple[int, int],
        shapes: Mapping[str, tuple[int, ...]],
        observation: int = 0,
    ) -> None:
        """Make room.

        Args:
          jobs: all of them, by index.
          traces: which traces are wanted, one of TRACES.
          trace: shape of one, control steps and numbers.
          shapes: of a trajectory's frames.
          observation: size d of an observation whose moments are wanted; 0: of none.
        """
        self.jobs, self._traces, self._trace, self._shapes = jobs, traces, trace, shapes
        self._rollouts, self._seen = jobs.rollouts, jobs.seen
        self._exploring = np.repeat(~self._seen, self._rollouts)
        self._starts = [0, *np.cumsum(self._rollouts).tolist()]  # of each job's rows, and the end
        self._trajectories: dict[int, WireTrajectory] = {}
        count = len(self._exploring)
        self.returns: FloatArray = np.zeros(count)
        """(S,)"""
        self.flags: BoolArray = np.zeros((count, 4), dtype=bool)
        """success, ended, failed, clamped, (S, 4)"""
        self.steps: IntArray = np.zeros(count, dtype=np.int64)
        """Control steps, (S,)"""
        self.moments: FloatArray = np.zeros((count, 1 + 2 * observation) if observation else (0, 0))
        """Of the observations, as in `farm.moments`, (S, 1 + 2 d), or (0, 0)"""
        self.done: BoolArray = np.zeros(len(jobs), dtype=bool)
        """Jobs whose results are here, (J,)"""
        self.traces: dict[int, AnyArray] = {}
        """Traces of the rollouts that brought one, (T, N) each"""

    def __len__(self) -> int:
        """How many jobs."""
        return len(self.jobs)

    def rows(self, job: int) -> slice:
        """Which rollouts are a job's."""
        return slice(self._starts[job], self._starts[job + 1])

    def trajectory(self, job: int) -> Trajectory | None:
        """What a job showed, if anything."""
        found = self._trajectories.get(job)
        return None if found is None else found.trajectory()

    def answer(self, job: int) -> bytes:
        """What a job gave, bit for bit."""
        return _bits(self, self.rows(job))

    def given(self, results: Results, job: int) -> bytes:
        """What results say of one of their jobs, in the form of `answer`."""
        before = int(self._rollouts[results.jobs[results.jobs < job]].sum())
        return _bits(results, slice(before, before + int(self._rollouts[job])))

    def job_returns(self) -> FloatArray:
        """The best return of each job's rollouts, (J,)."""
        return np.maximum.reduceat(self.returns, self._starts[:-1])

    def best(self) -> tuple[int, float]:
        """The job with the best return among those that explore, and that return; -inf where none explores."""
        returns = np.where(self._seen, -np.inf, self.job_returns())
        return int(returns.argmax()), float(returns.max())

    def forget(self, jobs: list[int]) -> None:
        """Drop what was shown of jobs that will be done again."""
        self.done[jobs] = False
        for job in jobs:
            self._trajectories.pop(job, None)
            for row in range(self._starts[job], self._starts[job + 1]):
                self.traces.pop(row, None)

    def place(self, results: Results) -> "Place | None":
        """Where these belong.

        None unless they are of jobs of this round, have their shapes, and the traces that are wanted of them.
        """
        jobs = results.jobs
        first, last = int(jobs[0]), int(jobs[-1])  # they rise
        if first < 0 or last >= len(self):
            return None
        rows = np.arange(self._starts[first], self._starts[last + 1])
        seen = self._seen[first : last + 1]
        if len(jobs) <= last - first:  # rare: some in between are missing
            mine = np.isin(np.arange(first, last + 1), jobs)
            rows, seen = rows[np.repeat(mine, self._rollouts[first : last + 1])], seen[mine]
        moments = (len(rows), self.moments.shape[1]) if self.moments.size else (0, 0)
        if len(results.returns) != len(rows) or len(results.trajectories) != np.count_nonzero(seen):
            return None
        if results.moments.shape != moments or not ((1 <= results.steps) & (results.steps <= self._trace[0])).all():
            return None
        wanted = traced(self._traces, results.returns, self._exploring[rows])
        traces = len(results.traces) == len(wanted) and (not len(wanted) or results.traces.shape[1:] == self._trace)
        if not (traces and all(trajectory.fits(self._shapes) for trajectory in results.trajectories)):
            return None
        return Place(rows, wanted, jobs[seen])

    def put(self, results: Results, place: "Place", chosen: BoolArray) -> None:
        """Write down some of results that belong here; `chosen` (J,) says of which jobs."""
        rows, new = place.rows, np.repeat(chosen, self._rollouts[results.jobs])
        some = slice(None) if chosen.all() else new
        self.returns[rows[some]] = results.returns[some]
        self.flags[rows[some]], self.steps[rows[some]] = results.flags[some], results.steps[some]
        if self.moments.size:
            self.moments[rows[some]] = results.moments[some]
        for at, trace in zip(place.traced.tolist(), results.traces, strict=True):
            if new[at]:
                self.traces[int(rows[at])] = trace
        self.done[results.jobs[chosen]] = True
        wanted = set(results.jobs[chosen].tolist())
        for job, trajectory in zip(place.shown.tolist(), results.trajectories, strict=True):
            if job in wanted:
                self._trajectories[job] = trajectory


def _bits(of: RoundResults | Results, rows: slice) -> bytes:
    """All that some rollouts gave and that a number may follow from."""
    return b"".join(values[rows].tobytes() for values in (of.returns, of.flags, of.steps, of.moments))


class Place(NamedTuple):
    """Where results belong."""

    rows: IntArray
    """Of their rollouts, in the round, (S,)"""
    traced: IntArray
    """Which of their rollouts have a trace, (K,)"""
    shown: IntArray
    """The jobs that their trajectories are of."""
