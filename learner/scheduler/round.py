"""A round's jobs, and what came of them: one array of each kind over all rollouts, in the jobs' order. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.net.work import Jobs, Results, WireTrajectory, traced
from farm.sim.trajectory import Trajectory


class RoundResults:
    """Jobs 0..n-1 and their results, S rollouts in all; a result is written where it belongs, whenever it comes."""

    def __init__(self, jobs: Jobs, traces: str, trace: tuple[int, int], shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Make room.

        Args:
          jobs: all of them, by index.
          traces: which traces are wanted, one of TRACES.
          trace: shape of one, control steps and numbers.
          shapes: of a trajectory's frames.
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
        if len(results.returns) != len(rows) or len(results.trajectories) != np.count_nonzero(seen):
            return None
        wanted = traced(self._traces, results.returns, self._exploring[rows])
        if len(results.traces) != len(wanted) or (len(wanted) and results.traces.shape[1:] != self._trace):
            return None
        if not all(trajectory.fits(self._shapes) for trajectory in results.trajectories):
            return None
        return Place(rows, wanted, jobs[seen])

    def put(self, results: Results, place: "Place", chosen: BoolArray) -> None:
        """Write down some of results that belong here; `chosen` (J,) says of which jobs."""
        rows, new = place.rows, np.repeat(chosen, self._rollouts[results.jobs])
        some = slice(None) if chosen.all() else new
        self.returns[rows[some]] = results.returns[some]
        self.flags[rows[some]] = results.flags[some]
        for at, trace in zip(place.traced.tolist(), results.traces, strict=True):
            if new[at]:
                self.traces[int(rows[at])] = trace
        wanted = set(results.jobs[chosen].tolist())
        for job, trajectory in zip(place.shown.tolist(), results.trajectories, strict=True):
            if job in wanted:
                self._trajectories[job] = trajectory


class Place(NamedTuple):
    """Where results belong."""

    rows: IntArray
    """Of their rollouts, in the round, (S,)"""
    traced: IntArray
    """Which of their rollouts have a trace, (K,)"""
    shown: IntArray
    """The jobs that their trajectories are of."""
