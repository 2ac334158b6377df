"""Messages about work: rounds and jobs to workers, results back.

Pure data in arrays, encoded by `farm.net.codec`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray, array
from farm.sim.trajectory import Trajectory

RATES: Final = ("none", "control", "physics")
"""Rates of the trajectory that a job returns besides its numbers; `none`: no trajectory."""

TRACES: Final = ("none", "extremes", "all", "steps")
"""Traces in results: none, those of the best and the worst exploring rollout of each message, or
all.

With `steps` they are of all, and hold each control step's observation, action and reward terms, and
all channels.

The best rollout of a round (the first of equal ones) is also the best of its message: with
`extremes` its trace is always included, however jobs are grouped.
"""

NOT_NORMALISED: Final = np.empty((2, 2, 0))
"""A RoundHeader's normaliser if observations are not normalised."""

_LINE: Final = 1000  # characters of a line
_LINES: Final = 40  # lines of a traceback


@dataclass(frozen=True, kw_only=True)
class RoundHeader:
    """Start of a round, with the mean that its jobs explore around."""

    run: str
    incarnation: str
    round: int
    generation: int
    spec: str
    """Digest of the Spec's bytes."""
    traces: str
    """Which traces the results contain, one of TRACES."""
    mu: FloatArray = array("<f8", 1)
    """(P,)"""
    normaliser: FloatArray = array("<f8", 3, NOT_NORMALISED)
    """Mean and standard deviation (2, d) of observations, twice: of all jobs, and of a job at
    physics rate that is not around the mean, which is a rollout of an earlier generation. d is 0 if
    observations are not normalised.
    """
    terms: bool = False
    """Whether the results contain each reward term's part of the returns."""

    def __post_init__(self) -> None:
        """Check the name of the traces, and that the standard deviations are positive."""
        if self.traces not in TRACES:
            raise ValueError(f"traces {self.traces[:40]!r}")
        if self.normaliser.shape[:2] != (2, 2) or not (self.normaliser[:, 1] > 0.0).all():
            raise ValueError(f"a normaliser of shape {self.normaliser.shape}, or not positive")


@dataclass(frozen=True, kw_only=True)
class Jobs:
    """Jobs as one table.

    A job is one rollout or a mirrored pair: origin + sign * eps for each of its signs.
    """

    table: IntArray = array("<i8", 2)
    """(J, 10): index; whether the origin is the mean (or zero); whether the job has eps; index of
    the rate in RATES; two signs, the second 0 for a single rollout; four words of the rollouts'
    seed, -1 for nominal conditions
    """
    eps: FloatArray = array("<f8", 2)
    """Perturbations of the K jobs that have one, in order (K, P)"""

    @staticmethod
    def exploring(
        eps: FloatArray, signs: tuple[int, ...], seeds: Sequence[tuple[int, ...]] | None
    ) -> "Jobs":
        """Jobs around the mean.

        Args:
          eps: (N, P).
          signs: the signs of each job.
          seeds: N seeds of four words; None for nominal conditions.
        """
        table = _table(len(eps), around=True, explores=True, rate="none", signs=signs)
        if seeds is not None:
            table[:, _SEED] = np.array(seeds, dtype="<i8").reshape(len(eps), 4)
        return Jobs(table=table, eps=eps)

    @staticmethod
    def mean(rate: str, seeds: Sequence[tuple[int, ...] | None]) -> "Jobs":
        """Rollouts of the mean itself, one per seed (None: nominal conditions)."""
        table = _table(len(seeds), around=True, explores=False, rate=rate, signs=(1,))
        table[:, _SEED] = np.array(
            [_NOMINAL if seed is None else seed for seed in seeds], dtype="<i8"
        ).reshape(-1, 4)
        return Jobs(table=table, eps=np.empty((0, 0)))

    @staticmethod
    def single(theta: FloatArray, rate: str, seed: tuple[int, ...] | None) -> "Jobs":
        """One rollout of parameters (P,)."""
        table = _table(1, around=False, explores=True, rate=rate, signs=(1,))
        table[:, _SEED] = _NOMINAL if seed is None else seed
        return Jobs(table=table, eps=theta[None])

    @staticmethod
    def joined(parts: Sequence["Jobs"]) -> "Jobs":
        """Concatenate jobs, with the new indices 0, 1, ..."""
        table = np.concatenate([part.table for part in parts])
        table[:, _INDEX] = np.arange(len(table))
        eps = [part.eps for part in parts if part.eps.size]
        return Jobs(
            table=table, eps=np.concatenate(eps) if len(eps) > 1 else (*eps, np.empty((0, 0)))[0]
        )

    def __len__(self) -> int:
        return len(self.table)

    @property
    def indices(self) -> IntArray:
        """Index of each job, (J,)."""
        return self.table[:, _INDEX]

    @property
    def around(self) -> BoolArray:
        """Which jobs are around the mean, (J,)."""
        return self.table[:, _AROUND] != 0

    @cached_property
    def rollouts(self) -> IntArray:
        """Number of rollouts of each job, (J,)."""
        return np.count_nonzero(self.table[:, _SIGN], axis=1)

    @property
    def explores(self) -> BoolArray:
        """Which jobs have parameters of their own, (J,)."""
        return self.table[:, _EXPLORES] != 0

    @property
    def seen(self) -> BoolArray:
        """Which jobs return a trajectory, (J,)."""
        return self.table[:, _RATE] != RATES.index("none")

    def traced(self, traces: str) -> BoolArray:
        """Which of the S rollouts may have a trace, of one of TRACES.

        They belong to jobs without a trajectory; unless it is `steps`, to those of them that
        explore.
        """
        jobs = ~self.seen if traces == "steps" else self.explores & ~self.seen
        return np.repeat(jobs, self.rollouts)

    @property
    def physics(self) -> BoolArray:
        """Which jobs return a trajectory at physics rate, (J,)."""
        return self.table[:, _RATE] == RATES.index("physics")

    def seeds(self) -> list[tuple[int, ...] | None]:
        """Seed of each of the S rollouts; None for nominal conditions."""
        words = [None if seed[0] < 0 else tuple(seed) for seed in self.table[:, _SEED].tolist()]
        return [
            seed
            for seed, count in zip(words, self.rollouts.tolist(), strict=True)
            for _ in range(count)
        ]

    def theta(self, mu: FloatArray) -> FloatArray:
        """Parameters of each rollout around a mean (P,): origin + sign * eps, (S, P)."""
        rows = np.repeat(np.arange(len(self)), self.rollouts)
        signs = self.table[:, _SIGN]
        signs = signs[signs != 0][:, None]
        out = np.where(self.around[rows, None], mu, 0.0)
        explores = self.explores[rows]
        if explores.all():  # the usual case
            out += signs * self.eps[rows]
        elif explores.any():  # otherwise eps may have no columns
            at = np.cumsum(self.table[:, _EXPLORES]) - 1  # row of each job's eps
            out[explores] += signs[explores] * self.eps[at[rows[explores]]]
        return out

    def take(self, positions: Sequence[int]) -> "Jobs":
        """Select jobs by position; views of the arrays if the positions are consecutive."""
        first, end = positions[0], positions[-1] + 1
        if list(positions) == list(range(first, end)):
            return Jobs(
                table=self.table[first:end], eps=self.eps[self._before[first] : self._before[end]]
            )
        table = self.table[list(positions)]
        before = np.array([self._before[at] for at in positions])
        return Jobs(table=table, eps=self.eps[before[table[:, _EXPLORES] != 0]])

    @cached_property
    def _before(self) -> list[int]:
        """Number of rows of eps before each job's, and the total, J + 1."""
        return [0, *np.cumsum(self.table[:, _EXPLORES]).tolist()]


@dataclass(frozen=True, kw_only=True)
class Chunk(Jobs):
    """Jobs for one worker."""

    run: str
    incarnation: str
    round: int

    def __post_init__(self) -> None:
        table, seeds = self.table, self.table[:, _SEED]
        if not table.size or table.shape[1] != _COLUMNS:
            raise ValueError(f"jobs in a table of shape {table.shape}")
        if (table < _LEAST).any() or (table > _MOST).any() or not table[:, _FIRST].all():
            raise ValueError("jobs out of range")
        if len(set(self.indices.tolist())) < len(self):
            raise ValueError("a job twice")
        nominal = seeds < 0
        if nominal.any() and (nominal.any(axis=1) != nominal.all(axis=1)).any():
            raise ValueError("a seed that is partly -1")
        if len(self.eps) != table[:, _EXPLORES].sum():
            raise ValueError(
                f"{len(self.eps)} rows of eps for {table[:, _EXPLORES].sum()} jobs that have eps"
            )

    @classmethod
    def carrying(cls, jobs: Jobs, *, run: str, incarnation: str, round: int) -> "Chunk":
        """A message with these jobs, at least one; unchecked, because a check takes as long as
        sending.
        """
        chunk = object.__new__(cls)
        vars(chunk).update(
            run=run, incarnation=incarnation, round=round, table=jobs.table, eps=jobs.eps
        )
        return chunk


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """Results of jobs: one array of each kind over all their S rollouts, in the jobs' order.

    The receiver derives each job's number of rollouts, and which of them have a trajectory or a
    trace, from the jobs that it issued (`rows_with_trace`). One map per job would take the learner
    ten times as long to read.
    """

    trajectories: tuple[Trajectory, ...]
    """The first rollout of each job that returns a trajectory"""
    returns: FloatArray = array("<f8", 1)
    """(S,)"""
    flags: BoolArray = array("|b1", 2)
    """success, ended, failed, clamped, (S, 4)"""
    steps: IntArray = array("<i8", 1)
    """Control steps, (S,)"""
    traces: AnyArray = array("<f4", 3)
    """Traces of the K rollouts selected by `rows_with_trace`, (K, T, N)"""
    moments: FloatArray = array("<f8", 2, np.empty((0, 0)))
    """Moments of the observations, as in `farm.moments`, (S, 1 + 2 d): zeros for rollouts that
    failed or return a trajectory.

    (0, 0) if observations are not normalised
    """
    measures: FloatArray = array("<f8", 2, np.empty((0, 0)))
    """Values of the task's measures, (S, M); (0, 0) if it has none"""
    terms: FloatArray = array("<f8", 2, np.empty((0, 0)))
    """Each reward term's part of the return, (S, K); (0, 0) if the round does not ask for them"""
    error: str = ""
    """Error of the first rollout that failed by the task's code, one line; empty if none did"""
    traceback: tuple[str, ...] = ()
    """Lines for the author of that code."""
    warned: dict[str, int] = field(default_factory=dict)
    """Number of rollouts in which MuJoCo warned, by kind: the name of mjtWarning without mjWARN_"""

    def __post_init__(self) -> None:
        """Check that all arrays have the same number of rollouts."""
        _check_told(self.error, self.traceback)
        if not all(0 < count <= len(self.returns) for count in self.warned.values()):
            raise ValueError(f"warnings of {str(self.warned)[:80]} in {len(self.returns)} rollouts")
        if self.flags.shape != (len(self.returns), 4):
            raise ValueError(f"flags of shape {self.flags.shape} for {len(self.returns)} rollouts")
        if len(self.steps) != len(self.returns):
            raise ValueError(f"{len(self.steps)} step counts for {len(self.returns)} rollouts")
        for values in (self.measures, self.terms):
            if values.shape != (0, 0) and len(values) != len(self.returns):
                raise ValueError(
                    f"measures or terms of shape {values.shape} for {len(self.returns)} rollouts"
                )
        if self.moments.shape != (0, 0):
            half = self.moments.shape[1] // 2 + 1
            if len(self.moments) != len(self.returns) or self.moments.shape[1] % 2 == 0:
                raise ValueError(
                    f"moments of shape {self.moments.shape} for {len(self.returns)} rollouts"
                )
            if (self.moments[:, :1] < 0.0).any() or (self.moments[:, half:] < 0.0).any():
                raise ValueError("moments that are negative")


@dataclass(frozen=True, kw_only=True)
class Results(Simulated):
    """Results of a chunk, worker to learner."""

    run: str
    incarnation: str
    round: int
    worker: str
    jobs: IntArray = array("<i8", 1)
    """Indices, ascending (J,)"""
    seconds: float = 0.0
    """Time of their simulation, without waiting for it [s]; 0: not measured"""

    def __post_init__(self) -> None:
        """Check also that there is at least one rollout per job."""
        super().__post_init__()
        if not 0.0 <= self.seconds < math.inf:
            raise ValueError(f"a simulation of {self.seconds} s")
        if not 1 <= len(self.jobs) <= len(self.returns):
            raise ValueError(f"{len(self.jobs)} jobs with {len(self.returns)} rollouts")
        jobs = self.jobs.tolist()
        if jobs != sorted(set(jobs)):
            raise ValueError("job indices that are not ascending")

    @classmethod
    def carrying(
        cls,
        simulated: Simulated,
        jobs: Jobs,
        seconds: float,
        *,
        run: str,
        incarnation: str,
        round: int,
        worker: str,
    ) -> "Results":
        """A message with the results of jobs, whose indices are ascending."""
        head: dict[str, Any] = {
            "run": run,
            "incarnation": incarnation,
            "round": round,
            "worker": worker,
        }
        return cls(
            **head, seconds=seconds, jobs=np.ascontiguousarray(jobs.indices), **vars(simulated)
        )


def rows_with_trace(traces: str, returns: FloatArray, traced: BoolArray) -> IntArray:
    """Indices of a message's rollouts that have a trace, ascending (K,).

    Args:
      traces: one of TRACES.
      returns: (S,).
      traced: which rollouts may have one, from `Jobs.traced`, (S,).
    """
    among = np.flatnonzero(traced)
    if traces in ("all", "steps"):
        return among
    if traces == "none" or not among.size:
        return among[:0]
    candidates = returns[among]
    return among[sorted({int(candidates.argmax()), int(candidates.argmin())})]


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that raised an exception (not a bad rollout), or a worker that cannot serve the run at
    all.
    """

    run: str
    incarnation: str
    round: int
    worker: str
    index: int | None
    """The job; None if the worker can run no job of this run."""
    error: str
    """One line."""
    traceback: tuple[str, ...] = ()
    """Lines for the author of the code if the error is outside the farm's own code."""

    def __post_init__(self) -> None:
        """Check that it can be displayed."""
        _check_told(self.error, self.traceback)


def _check_told(error: str, traceback: tuple[str, ...]) -> None:
    """Check that an error that was sent can be displayed."""
    if len(traceback) > _LINES:
        raise ValueError(f"a traceback of {len(traceback)} lines")
    for line in (error, *traceback):
        if len(line) > _LINE or not line.isprintable():
            raise ValueError(
                f"an error of more than {_LINE} characters a line, or unprintable ones"
            )


def _table(
    count: int, *, around: bool, explores: bool, rate: str, signs: tuple[int, ...]
) -> IntArray:
    table = np.empty((count, _COLUMNS), dtype="<i8")
    table[:] = (0, around, explores, RATES.index(rate), *(*signs, 0)[:2], *_NOMINAL)
    table[:, _INDEX] = np.arange(count)
    return table


_COLUMNS: Final = 10
_INDEX, _AROUND, _EXPLORES, _RATE, _FIRST, _SIGN, _SEED = 0, 1, 2, 3, 4, slice(4, 6), slice(6, 10)
_LEAST: Final = np.array([0, 0, 0, 0, -1, -1, -1, -1, -1, -1])
_MOST: Final = np.array([2**31 - 1, 1, 1, len(RATES) - 1, 1, 1, *[2**32 - 1] * 4])
_NOMINAL: Final = (-1, -1, -1, -1)
