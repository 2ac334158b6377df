"""A round's jobs and their results: one array per quantity, over all rollouts in the order of the
jobs.

Pure.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.net.work import Jobs, Results, Simulated, rows_with_trace
from farm.sim.trajectory import Trajectory

# [bytes] of jobs, and of their results, in one message, unless one job alone has more
_MESSAGE: Final = 8 << 20
_SPARE: Final = 1 << 20  # [bytes] of whatever else is in a message, such as a traceback


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """Shapes of a run's results."""

    trace: tuple[int, int]
    """Control steps of a rollout, and numbers per step of its trace"""
    frame: Mapping[str, tuple[int, ...]]
    """Shape of a frame of each of a trajectory's arrays"""
    observation: int = 0
    """Size d of the observation"""
    measures: int = 0
    """Number M of the task's measures"""
    substeps: int = 1
    """Physics steps of a control step"""

    def answer_bytes(self, *, trajectory: bool = True, traces: bool = True) -> int:
        """Largest number of bytes that answer one job: two rollouts, their traces, and a
        trajectory at physics rate.
        """
        terms = int(np.prod(self.frame.get("terms", (0,))))
        # Returns, steps, moments...; flags
        numbers = 8 * (2 + 1 + 2 * self.observation + self.measures + terms) + 4
        frame = 8 + 4 * sum(int(np.prod(shape)) for shape in self.frame.values())
        trace = 4 * self.trace[0] * self.trace[1]
        frames = self.trace[0] * self.substeps + 1
        return 2 * (numbers + traces * trace) + trajectory * frames * frame

    @property
    def largest_message(self) -> int:
        """Largest number of bytes of an answer: the jobs of a message with one more, the traces of
        its best and worst rollout.
        """
        return _MESSAGE + 2 * self.answer_bytes() + _SPARE


class RoundResults:
    """Jobs 0..n-1 and their results, S rollouts in all. Results may arrive in any order."""

    def __init__(
        self,
        jobs: Jobs,
        traces: str,
        shapes: Shapes,
        *,
        observed: bool = False,
        terms: bool = False,
    ) -> None:
        """Allocate the arrays.

        Args:
          jobs: all jobs of the round, by index.
          traces: which traces workers must send, one of TRACES.
          shapes: of the results.
          observed: whether workers must send the moments of the observations.
          terms: whether workers must send each reward term's part of the returns.
        """
        self.jobs = jobs
        self._traces = traces
        self._trace = shapes.trace
        self._shapes = shapes.frame
        self._rollouts, self._seen = jobs.rollouts, jobs.seen
        self._traced = jobs.traced(traces)
        plain = ~self._seen
        self._candidates = plain & jobs.explores if jobs.explores.any() else plain
        # First row of each job, and the end
        self._starts = [0, *np.cumsum(self._rollouts).tolist()]
        self._trajectories: dict[int, Trajectory] = {}
        count, measures = len(self._traced), shapes.measures
        # The two traces of `extremes` are one message's, not a job's
        whole = traces in ("all", "steps")
        with_trajectory, plain = (
            shapes.answer_bytes(trajectory=one, traces=whole) for one in (True, False)
        )
        self._bytes = np.maximum(
            np.where(self._seen, with_trajectory, plain), jobs.eps.nbytes // max(1, len(jobs.eps))
        )
        self.returns: FloatArray = np.zeros(count)
        """(S,)"""
        self.flags: BoolArray = np.zeros((count, 4), dtype=bool)
        """success, ended, failed, clamped, (S, 4)"""
        self.steps: IntArray = np.zeros(count, dtype=np.int64)
        """Control steps, (S,)"""
        self.moments: FloatArray = np.zeros(
            (count, 1 + 2 * shapes.observation) if observed else (0, 0)
        )
        """Moments of the observations, as in `farm.moments`, (S, 1 + 2 d), or (0, 0)"""
        self.measures: FloatArray = np.zeros((count, measures) if measures else (0, 0))
        """Values of the task's measures, (S, M), or (0, 0)"""
        self.terms: FloatArray = np.zeros((count, *shapes.frame["terms"]) if terms else (0, 0))
        """Each reward term's part of the return, (S, K), or (0, 0)"""
        self.done: BoolArray = np.zeros(len(jobs), dtype=bool)
        """Jobs whose results have arrived, (J,)"""
        self.traces: dict[int, AnyArray] = {}
        """Traces by rollout, (T, N) each; only of some rollouts"""

    def __len__(self) -> int:
        """Number of jobs."""
        return len(self.jobs)

    def messages(self, jobs: Sequence[int]) -> Iterator[Sequence[int]]:
        """Cut jobs into messages, so that no message, and no answer to one, is much larger than the
        others.
        """
        message = np.cumsum(self._bytes[list(jobs)]) // _MESSAGE
        ends = [0, *(np.flatnonzero(np.diff(message)) + 1).tolist(), len(jobs)]
        for first, end in itertools.pairwise(ends):
            yield jobs[first:end]

    def rows(self, job: int) -> slice:
        """Rows of a job's rollouts."""
        return slice(self._starts[job], self._starts[job + 1])

    def trajectory(self, job: int | None) -> Trajectory | None:
        """The trajectory of a job, None if it has none, or there is no such job."""
        return None if job is None else self._trajectories.get(job)

    def kept_traces(self, rollouts: int) -> dict[str, AnyArray]:
        """The traces to keep of the first rollouts, by name; each has (T, N) per rollout."""
        if self._traces == "none":
            return {}
        returns = self.returns[:rollouts]
        rows = {"best": int(returns.argmax()), "worst": int(returns.argmin())}
        # If machines round differently, a job that ran twice may have sent the trace of another
        # rollout.
        extremes = {
            name: self.traces[row].copy() for name, row in rows.items() if row in self.traces
        }
        whole = (
            {"all": np.stack([self.traces[row] for row in range(rollouts)])}
            if self._traces == "all"
            else {}
        )
        return extremes | whole

    def answer(self, job: int) -> bytes:
        """The stored results of a job, as bytes."""
        return bits(self, self.rows(job))

    def given(self, results: Results, job: int) -> bytes:
        """The part of a message's results that belongs to one of its jobs, in the form of
        `answer`.
        """
        before = int(self._rollouts[results.jobs[results.jobs < job]].sum())
        return bits(results, slice(before, before + int(self._rollouts[job])))

    def job_returns(self) -> FloatArray:
        """The best return of each job's rollouts, (J,)."""
        return np.maximum.reduceat(self.returns, self._starts[:-1])

    def best(self) -> tuple[int, float]:
        """The job with the best return, and that return, of those without a trajectory; -inf if
        there is none.

        If some jobs explore, only those count.
        """
        returns = np.where(self._candidates, self.job_returns(), -np.inf)
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
        shows = self._seen[first : last + 1]
        if len(jobs) <= last - first:  # rare: some in between are missing
            mask = np.isin(np.arange(first, last + 1), jobs)
            rows, shows = rows[np.repeat(mask, self._rollouts[first : last + 1])], shows[mask]
        if any(
            values.shape != _expected(array, len(rows)) for array, values in self._more(results)
        ):
            return None
        if len(results.returns) != len(rows) or len(results.trajectories) != np.count_nonzero(
            shows
        ):
            return None
        if not ((1 <= results.steps) & (results.steps <= self._trace[0])).all():
            return None
        with_trace = rows_with_trace(self._traces, results.returns, self._traced[rows])
        traces = len(results.traces) == len(with_trace) and (
            not len(with_trace) or results.traces.shape[1:] == self._trace
        )
        if not (
            traces and all(trajectory.fits(self._shapes) for trajectory in results.trajectories)
        ):
            return None
        return Place(rows, with_trace, jobs[shows])

    def put(self, results: Results, place: "Place", mask: BoolArray) -> None:
        """Store the results of the jobs in the mask, which has one entry per job of the message."""
        rows, mask_of_rows = place.rows, np.repeat(mask, self._rollouts[results.jobs])
        selection = slice(None) if mask.all() else mask_of_rows
        self.returns[rows[selection]] = results.returns[selection]
        self.flags[rows[selection]] = results.flags[selection]
        self.steps[rows[selection]] = results.steps[selection]
        for array, values in self._more(results):
            if array.size:
                array[rows[selection]] = values[selection]
        for at, trace in zip(place.with_trace.tolist(), results.traces, strict=True):
            if mask_of_rows[at]:
                self.traces[int(rows[at])] = trace
        self.done[results.jobs[mask]] = True
        indices = set(results.jobs[mask].tolist())
        for job, trajectory in zip(place.shown.tolist(), results.trajectories, strict=True):
            if job in indices:
                self._trajectories[job] = trajectory

    def _more(self, results: Results) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """The arrays that not every run has, here and in results."""
        return (
            (self.moments, results.moments),
            (self.measures, results.measures),
            (self.terms, results.terms),
        )


def _expected(array: FloatArray, count: int) -> tuple[int, int]:
    """Shape of a message's array of this number of rollouts."""
    return (count, array.shape[1]) if array.size else (0, 0)


def bits(of: RoundResults | Simulated, rows: slice) -> bytes:
    """Results of some rollouts that can influence the run's numbers, as bytes."""
    arrays = (of.returns, of.flags, of.steps, of.moments, of.measures, of.terms)
    return b"".join(values[rows].tobytes() for values in arrays)


class Place(NamedTuple):
    """Rows of the round to which a message's results belong."""

    rows: IntArray
    """Row of each of the message's S rollouts, (S,)"""
    with_trace: IntArray
    """Rows of the message's rollouts that have a trace, (K,)"""
    shown: IntArray
    """The job of each of its trajectories."""
