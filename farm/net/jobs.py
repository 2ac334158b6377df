"""What a learner gives its workers: a round's mean, and rollouts to simulate around it. Pure, as `farm.net.messages`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.net.codec import array

RATES: Final = ("none", "control", "physics")
"""How much of a rollout a job wants to see, besides its figures: nothing, or a trajectory at that rate."""

TRACES: Final = ("none", "extremes", "all")
"""Tactile traces that results bring: none, of the best and the worst exploring rollout of each message, of all of them.

The best rollout of a round (of equals the first) is the best of the message that brings it: with `extremes` its trace
is never missed, whichever jobs travel together.
"""


@dataclass(frozen=True, kw_only=True)
class Generation:
    """A round that begins: the mean that its jobs explore around."""

    run: str
    incarnation: str
    round: int
    generation: int
    spec: str
    """Digest of the Spec's bytes."""
    traces: str
    """Which tactile traces results bring, one of TRACES."""
    mu: FloatArray = array("<f8", 1)
    """(P,)"""

    def __post_init__(self) -> None:
        """Check the name."""
        if self.traces not in TRACES:
            raise ValueError(f"traces {self.traces[:40]!r}")


@dataclass(frozen=True, kw_only=True)
class Job:
    """Rollouts of origin + sign * eps for each sign, under one perturbation."""

    index: int
    origin: str
    """`mu`: the generation's mean; `zero`: eps are the parameters themselves."""
    signs: tuple[int, ...]
    """(1, -1) for a pair, (1,) for one rollout."""
    perturbation: tuple[int, ...] | None
    """Seed of the perturbation that all these rollouts share, four 32-bit words; None for nominal conditions."""
    rate: str
    """One of RATES."""
    eps: FloatArray = array("<f8", 1)
    """(P,), or (0,) for zeros"""

    def __post_init__(self) -> None:
        """Check names and signs."""
        if self.origin not in ("mu", "zero"):
            raise ValueError(f"a job around {self.origin!r}")
        if self.rate not in RATES or self.signs not in _SIGNS:
            raise ValueError(f"a job of signs {self.signs} and rate {self.rate!r}")
        seed = (0, 0, 0, 0) if self.perturbation is None else self.perturbation
        if not 0 <= self.index < 2**31 or len(seed) != 4 or min(seed) < 0 or max(seed) >= 2**32:
            raise ValueError(f"a job of index {self.index} and perturbation {self.perturbation}")


@dataclass(frozen=True, kw_only=True)
class Jobs:
    """Jobs as one table: a map or an object for each would take ten times as long to send and to read."""

    table: IntArray = array("<i8", 2)
    """(J, 10): index; whether the origin is the mean; whether there are eps; place of the rate in RATES;
    two signs, the second 0 for a single rollout; four words of the perturbation's seed, -1 for nominal conditions"""
    eps: FloatArray = array("<f8", 2)
    """Of those jobs that have some, one after the other (K, P)"""

    @staticmethod
    def of(jobs: Sequence[Job]) -> "Jobs":
        """At least one job."""
        eps = [job.eps for job in jobs if job.eps.size]
        rows = [
            (
                job.index, job.origin == "mu", job.eps.size > 0, RATES.index(job.rate), *(*job.signs, 0)[:2],
                *(_NOMINAL if job.perturbation is None else job.perturbation),
            )
            for job in jobs
        ]  # fmt: skip
        return Jobs(table=np.array(rows, dtype="<i8"), eps=np.stack(eps) if eps else np.empty((0, 0)))

    @staticmethod
    def exploring(
        eps: FloatArray, signs: tuple[int, ...], seeds: Sequence[tuple[int, ...]] | None, then: Sequence[Job]
    ) -> "Jobs":
        """Jobs 0..N-1 around the mean, and at least one further job.

        Args:
          eps: (N, P).
          signs: of each.
          seeds: of their perturbations, N of four words; None for nominal conditions.
          then: what comes behind them, with the indices from N on.
        """
        count, others = len(eps), Jobs.of(then)
        table = np.empty((count, _COLUMNS), dtype="<i8")
        table[:] = (0, True, True, RATES.index("none"), *(*signs, 0)[:2], *_NOMINAL)
        table[:, _INDEX] = np.arange(count)
        if seeds is not None:
            table[:, _SEED] = np.array(seeds, dtype="<i8").reshape(count, 4)
        return Jobs(
            table=np.concatenate([table, others.table]),
            eps=np.concatenate([eps, others.eps]) if others.eps.size else eps,
        )

    def __len__(self) -> int:
        """How many."""
        return len(self.table)

    @property
    def indices(self) -> IntArray:
        """Of each job, (J,)."""
        return self.table[:, _INDEX]

    @property
    def rollouts(self) -> IntArray:
        """How many each job has, (J,)."""
        return np.count_nonzero(self.table[:, _SIGN], axis=1)

    @property
    def seen(self) -> BoolArray:
        """Which jobs want a trajectory, (J,)."""
        return self.table[:, _RATE] != RATES.index("none")

    def take(self, chosen: Sequence[int]) -> "Jobs":
        """Some of these jobs, by their places here; views where they stand side by side."""
        first, end = chosen[0], chosen[-1] + 1
        if list(chosen) == list(range(first, end)):
            return Jobs(table=self.table[first:end], eps=self.eps[self._before[first] : self._before[end]])
        table, before = self.table[list(chosen)], np.array([self._before[at] for at in chosen])
        return Jobs(table=table, eps=self.eps[before[table[:, _EXPLORES] != 0]])

    def split(self) -> list[Job]:
        """Job by job again; the arrays are views."""
        rows = iter(self.eps)
        return [
            Job(
                index=index,
                origin="mu" if around else "zero",
                signs=(first, second) if second else (first,),
                perturbation=None if seed[0] < 0 else tuple(seed),
                rate=RATES[rate],
                eps=next(rows) if explores else _NO_EPS,
            )
            for index, around, explores, rate, first, second, *seed in self.table.tolist()
        ]

    @cached_property
    def _before(self) -> list[int]:
        """How many rows of eps stand before each job's, and how many there are, J + 1."""
        return [0, *np.cumsum(self.table[:, _EXPLORES]).tolist()]


@dataclass(frozen=True, kw_only=True)
class Chunk(Jobs):
    """Jobs for one worker."""

    run: str
    incarnation: str
    round: int

    def __post_init__(self) -> None:
        """Check that there are such jobs."""
        table, seeds = self.table, self.table[:, _SEED]
        if not table.size or table.shape[1] != _COLUMNS:
            raise ValueError(f"jobs in a table of shape {table.shape}")
        if (table < _LEAST).any() or (table > _MOST).any() or not table[:, _FIRST].all():
            raise ValueError("jobs out of range")
        if len(set(self.indices.tolist())) < len(self):
            raise ValueError("a job twice")
        nominal = seeds < 0
        if nominal.any() and (nominal.any(axis=1) != nominal.all(axis=1)).any():
            raise ValueError("half a seed")
        if len(self.eps) != table[:, _EXPLORES].sum():
            raise ValueError(f"{len(self.eps)} rows of eps of {table[:, _EXPLORES].sum()} jobs")

    @classmethod
    def carrying(cls, jobs: Jobs, *, run: str, incarnation: str, round: int) -> "Chunk":
        """At least one job, ready to send."""
        return cls(run=run, incarnation=incarnation, round=round, table=jobs.table, eps=jobs.eps)


_COLUMNS: Final = 10
_INDEX, _EXPLORES, _RATE, _FIRST, _SIGN, _SEED = 0, 2, 3, 4, slice(4, 6), slice(6, 10)
_LEAST: Final = np.array([0, 0, 0, 0, -1, -1, -1, -1, -1, -1])
_MOST: Final = np.array([2**31 - 1, 1, 1, len(RATES) - 1, 1, 1, *[2**32 - 1] * 4])

_SIGNS: Final = ((1, -1), (1,), (-1,), (-1, 1), (1, 1), (-1, -1))

_NOMINAL: Final = (-1, -1, -1, -1)

_NO_EPS: Final = np.empty(0)
