"""A round's jobs, and what came of them: one array of each kind over all rollouts, in the jobs' order. Pure."""

from collections.abc import Iterator, Mapping

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.jobs import RATES, Jobs
from farm.results import Result, Results, WireTrajectory, traced


class Round:
    """Jobs 0..n-1 and their results, S rollouts in all; a result is written where it belongs, whenever it comes."""

    def __init__(self, jobs: Jobs, traces: str, trace: tuple[int, int], shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Make room.

        Args:
          jobs: all of them, by index.
          traces: which tactile traces are wanted, one of TRACES.
          trace: steps and taxels of one.
          shapes: of a trajectory's frames.
        """
        self.jobs, self._traces, self._trace, self._shapes = jobs, traces, trace, shapes
        self._rollouts = np.count_nonzero(jobs.signs, axis=1)
        self._ends = np.cumsum(self._rollouts)
        self._starts = self._ends - self._rollouts
        self._seen = jobs.rates != RATES.index("none")
        self._trajectories: dict[int, WireTrajectory] = {}
        count = int(self._rollouts.sum())
        self.returns: FloatArray = np.zeros(count)
        """(S,)"""
        self.steps = np.zeros(count, dtype="<i8")
        """Control steps until the end, (S,)"""
        self.flags: BoolArray = np.zeros((count, 4), dtype=bool)
        """success, dropped, failed, clamped, (S, 4)"""
        self.traces: dict[int, AnyArray] = {}
        """Tactile traces [N] of the rollouts that brought one, (T, 54) each"""

    def __len__(self) -> int:
        """How many jobs."""
        return len(self.jobs)

    def __getitem__(self, index: int) -> Result:
        """One job's result, without traces; the arrays are views."""
        at = index + len(self) if index < 0 else index
        rows = slice(int(self._starts[at]), int(self._ends[at]))
        success, dropped, failed, clamped = self.flags[rows].T
        return Result(
            index=at, trajectory=self._trajectories.get(at), returns=self.returns[rows], success=success,
            steps=self.steps[rows], dropped=dropped, failed=failed, clamped=clamped,
            traces=np.empty((rows.stop - rows.start, 0, self._trace[1]), "<f4"),
        )  # fmt: skip

    def __iter__(self) -> Iterator[Result]:
        """Job by job."""
        return (self[index] for index in range(len(self)))

    def fits(self, results: Results) -> bool:
        """Whether these are of jobs of this round, have their shapes, and the traces that are wanted of them."""
        jobs = results.jobs  # they rise
        if jobs[0] < 0 or jobs[-1] >= len(self) or (results.rollouts != self._rollouts[jobs]).any():
            return False
        if (results.seen != self._seen[jobs]).any():
            return False
        wanted = traced(self._traces, results.returns, results.rollouts, results.seen)
        if not np.array_equal(results.traced, wanted) or (len(wanted) and results.traces.shape[1:] != self._trace):
            return False
        return all(trajectory.fits(self._shapes) for trajectory in results.trajectories)

    def put(self, results: Results, chosen: BoolArray) -> None:
        """Write down some (J,) of results that fit."""
        rows, new = self._rows(results), np.repeat(chosen, results.rollouts)
        some = slice(None) if new.all() else new
        for mine, theirs in (
            (self.returns, results.returns),
            (self.steps, results.steps),
            (self.flags, results.flags),
        ):
            mine[rows[some]] = theirs[some]
        for at, trace in zip(results.traced.tolist(), results.traces, strict=True):
            if new[at]:
                self.traces[int(rows[at])] = trace
        for at, trajectory in zip(np.flatnonzero(results.seen).tolist(), results.trajectories, strict=True):
            if chosen[at]:
                self._trajectories[int(results.jobs[at])] = trajectory

    def _rows(self, results: Results) -> IntArray:
        """Where each of these rollouts belongs, (S,)."""
        first, last = results.jobs[0], results.jobs[-1]
        if last - first == len(results.jobs) - 1:  # nearly always
            return np.arange(self._starts[first], self._ends[last])
        before = np.cumsum(results.rollouts) - results.rollouts
        return np.repeat(self._starts[results.jobs] - before, results.rollouts) + np.arange(len(results.returns))
