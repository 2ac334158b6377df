"""A round's jobs and their results: one array per quantity, over all rollouts in the order of the jobs. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.net.work import Jobs, Results, Simulated, traced
from farm.sim.trajectory import Trajectory


class RoundResults:
    """Jobs 0..n-1 and their results, S rollouts in all. Results may arrive in any order."""

    def __init__(
        self,
        jobs: Jobs,
        traces: str,
        trace: tuple[int, int],
        shapes: Mapping[str, tuple[int, ...]],
        observation: int = 0,
        *,
        measures: int = 0,
        terms: bool = False,
    ) -> None:
        """Allocate the arrays.

        Args:
          jobs: all jobs of the round, by index.
          traces: which traces workers must send, one of TRACES.
          trace: shape of a trace: control steps, numbers per step.
          shapes: shape of a frame of each of a trajectory's arrays.
          observation: size d of the observation, if its moments are collected; else 0.
          measures: number M of the task's measures.
          terms: whether workers must send each reward term's part of the returns.
        """
        self.jobs, self._traces, self._trace, self._shapes = jobs, traces, trace, shapes
        self._rollouts, self._seen = jobs.rollouts, jobs.seen
        self._exploring = np.repeat(~self._seen, self._rollouts)
        self._starts = [0, *np.cumsum(self._rollouts).tolist()]  # first row of each job, and the end
        self._trajectories: dict[int, Trajectory] = {}
        count = len(self._exploring)
        self.returns: FloatArray = np.zeros(count)
        """(S,)"""
        self.flags: BoolArray = np.zeros((count, 4), dtype=bool)
        """success, ended, failed, clamped, (S, 4)"""
        self.steps: IntArray = np.zeros(count, dtype=np.int64)
        """Control steps, (S,)"""
        self.moments: FloatArray = np.zeros((count, 1 + 2 * observation) if observation else (0, 0))
        """Moments of the observations, as in `farm.moments`, (S, 1 + 2 d), or (0, 0)"""
        self.measures: FloatArray = np.zeros((count, measures) if measures else (0, 0))
        """Of the task's measures, (S, M), or (0, 0)"""
        self.terms: FloatArray = np.zeros((count, *shapes["terms"]) if terms else (0, 0))
        """Each reward term's part of the return, (S, K), or (0, 0)"""
        self.done: BoolArray = np.zeros(len(jobs), dtype=bool)
        """Jobs whose results have arrived, (J,)"""
        self.traces: dict[int, AnyArray] = {}
        """Traces by rollout, (T, N) each; only of some rollouts"""

    def __len__(self) -> int:
        """Number of jobs."""
        return len(self.jobs)

    def rows(self, job: int) -> slice:
        """Rows of a job's rollouts."""
        return slice(self._starts[job], self._starts[job + 1])

    def trajectory(self, job: int) -> Trajectory | None:
        """The trajectory of a job, None if it has none."""
        return self._trajectories.get(job)

    def kept_traces(self, rollouts: int) -> dict[str, AnyArray]:
        """The traces to keep of the first rollouts, by name; each has (T, N) per rollout."""
        if self._traces == "none":
            return {}
        returns = self.returns[:rollouts]
        rows = {"best": int(returns.argmax()), "worst": int(returns.argmin())}
        # If machines round differently, a job that ran twice may have sent the trace of another rollout.
        kept = {name: self.traces[row].copy() for name, row in rows.items() if row in self.traces}
        whole = {"all": np.stack([self.traces[row] for row in range(rollouts)])} if self._traces == "all" else {}
        return kept | whole

    def answer(self, job: int) -> bytes:
        """The stored results of a job, as bytes."""
        return bits(self, self.rows(job))

    def given(self, results: Results, job: int) -> bytes:
        """The part of a message's results that belongs to one of its jobs, in the form of `answer`."""
        before = int(self._rollouts[results.jobs[results.jobs < job]].sum())
        return bits(results, slice(before, before + int(self._rollouts[job])))

    def job_returns(self) -> FloatArray:
        """The best return of each job's rollouts, (J,)."""
        return np.maximum.reduceat(self.returns, self._starts[:-1])

    def best(self) -> tuple[int, float]:
        """The exploring job with the best return, and that return; -inf if no job explores."""
        returns = np.where(self._seen, -np.inf, self.job_returns())
        return int(returns.argmax()), float(returns.max())

    def forget(self, jobs: list[int]) -> None:
        """Drop trajectories and traces of jobs that will be repeated."""
        self.done[jobs] = False
        for job in jobs:
            self._trajectories.pop(job, None)
            for row in range(self._starts[job], self._starts[job + 1]):
                self.traces.pop(row, None)

    def place(self, results: Results) -> "Place | None":
        """Rows to which these results belong.

        None unless they are of jobs of this round, with the right shapes and the required traces.
        """
        jobs = results.jobs
        first, last = int(jobs[0]), int(jobs[-1])  # in ascending order
        if first < 0 or last >= len(self):
            return None
        rows = np.arange(self._starts[first], self._starts[last + 1])
        seen = self._seen[first : last + 1]
        if len(jobs) <= last - first:  # rare: some in between are missing
            mine = np.isin(np.arange(first, last + 1), jobs)
            rows, seen = rows[np.repeat(mine, self._rollouts[first : last + 1])], seen[mine]
        if any(given.shape != _expected(own, len(rows)) for own, given in self._more(results)):
            return None
        if len(results.returns) != len(rows) or len(results.trajectories) != np.count_nonzero(seen):
            return None
        if not ((1 <= results.steps) & (results.steps <= self._trace[0])).all():
            return None
        wanted = traced(self._traces, results.returns, self._exploring[rows])
        traces = len(results.traces) == len(wanted) and (not len(wanted) or results.traces.shape[1:] == self._trace)
        if not (traces and all(trajectory.fits(self._shapes) for trajectory in results.trajectories)):
            return None
        return Place(rows, wanted, jobs[seen])

    def put(self, results: Results, place: "Place", chosen: BoolArray) -> None:
        """Store the results of the chosen jobs; `chosen` has one entry per job of the message."""
        rows, new = place.rows, np.repeat(chosen, self._rollouts[results.jobs])
        some = slice(None) if chosen.all() else new
        self.returns[rows[some]] = results.returns[some]
        self.flags[rows[some]], self.steps[rows[some]] = results.flags[some], results.steps[some]
        for own, given in self._more(results):
            if own.size:
                own[rows[some]] = given[some]
        for at, trace in zip(place.traced.tolist(), results.traces, strict=True):
            if new[at]:
                self.traces[int(rows[at])] = trace
        self.done[results.jobs[chosen]] = True
        wanted = set(results.jobs[chosen].tolist())
        for job, trajectory in zip(place.shown.tolist(), results.trajectories, strict=True):
            if job in wanted:
                self._trajectories[job] = trajectory

    def _more(self, results: Results) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """The arrays that not every run has, here and in results."""
        return (
            (self.moments, results.moments), (self.measures, results.measures), (self.terms, results.terms)
        )  # fmt: skip


def _expected(own: FloatArray, count: int) -> tuple[int, int]:
    """Shape of a message's array of this number of rollouts."""
    return (count, own.shape[1]) if own.size else (0, 0)


def bits(of: RoundResults | Simulated, rows: slice) -> bytes:
    """All results of some rollouts that can influence the run's numbers, as bytes."""
    arrays = (of.returns, of.flags, of.steps, of.moments, of.measures, of.terms)
    return b"".join(values[rows].tobytes() for values in arrays)


class Place(NamedTuple):
    """Rows of the round to which a message's results belong."""

    rows: IntArray
    """Row of each of the message's S rollouts, (S,)"""
    traced: IntArray
    """Those of its rollouts that have a trace, (K,)"""
    shown: IntArray
    """The job of each of its trajectories."""
