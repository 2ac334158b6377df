"""What a learner gives its workers: a round's mean, and rollouts to simulate around it. Pure, as `farm.messages`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray, within
from farm.codec import array

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
    """Jobs as one array of each kind over all of them: a map or an object for each would take ten times as long."""

    jobs: IntArray = array("<i8", 1)
    """Indices, (J,)"""
    around: BoolArray = array("|b1", 1)
    """Whether the origin is the generation's mean, (J,)"""
    signs: IntArray = array("<i8", 2)
    """(J, 2), the second 0 for a single rollout"""
    seeds: IntArray = array("<i8", 2)
    """Of the perturbations, (J, 4), -1 for nominal conditions"""
    rates: IntArray = array("<i8", 1)
    """Positions in RATES, (J,)"""
    explores: BoolArray = array("|b1", 1)
    """Which jobs have eps, (J,)"""
    eps: FloatArray = array("<f8", 2)
    """Of those that have, one after the other (K, P)"""

    @staticmethod
    def of(jobs: Sequence[Job]) -> "Jobs":
        """At least one job."""
        eps = [job.eps for job in jobs if job.eps.size]
        return Jobs(
            jobs=np.array([job.index for job in jobs]),
            around=np.array([job.origin == "mu" for job in jobs]),
            signs=np.array([(*job.signs, 0)[:2] for job in jobs]),
            seeds=np.array([_NOMINAL if job.perturbation is None else job.perturbation for job in jobs]),
            rates=np.array([RATES.index(job.rate) for job in jobs]),
            explores=np.array([job.eps.size > 0 for job in jobs]),
            eps=np.stack(eps) if eps else np.empty((0, 0)),
        )

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
        every = np.ones(count, dtype=bool)
        return Jobs(
            jobs=np.append(np.arange(count), others.jobs),
            around=np.append(every, others.around),
            signs=np.concatenate([np.tile((*signs, 0)[:2], (count, 1)), others.signs]),
            seeds=np.concatenate([np.tile(_NOMINAL, (count, 1)) if seeds is None else np.array(seeds), others.seeds]),
            rates=np.append(np.full(count, RATES.index("none")), others.rates),
            explores=np.append(every, others.explores),
            eps=np.concatenate([eps, others.eps]) if others.eps.size else eps,
        )

    def __len__(self) -> int:
        """How many."""
        return len(self.jobs)

    def take(self, chosen: Sequence[int]) -> "Jobs":
        """Some of these jobs, by their places here; views where they stand side by side."""
        if list(chosen) == list(range(chosen[0], chosen[-1] + 1)):
            at: IntArray | slice = slice(chosen[0], chosen[-1] + 1)
            explores, before = self.explores[at], np.count_nonzero(self.explores[: chosen[0]])
            rows: IntArray | slice = slice(before, before + np.count_nonzero(explores))
        else:
            at = np.array(chosen)
            explores = self.explores[at]
            rows = (np.cumsum(self.explores) - 1)[at[explores]]
        return Jobs(
            jobs=self.jobs[at], around=self.around[at], signs=self.signs[at], seeds=self.seeds[at],
            rates=self.rates[at], explores=explores, eps=self.eps[rows],
        )  # fmt: skip

    def split(self) -> list[Job]:
        """Job by job again; the arrays are views."""
        eps, around, explores = iter(self.eps), self.around.tolist(), self.explores.tolist()
        signs, seeds, rates = self.signs.tolist(), self.seeds.tolist(), self.rates.tolist()
        return [
            Job(
                index=index,
                origin="mu" if around[i] else "zero",
                signs=tuple(sign for sign in signs[i] if sign),
                perturbation=None if seeds[i][0] < 0 else tuple(seeds[i]),
                rate=RATES[rates[i]],
                eps=next(eps) if explores[i] else _NO_EPS,
            )
            for i, index in enumerate(self.jobs.tolist())
        ]


@dataclass(frozen=True, kw_only=True)
class Chunk(Jobs):
    """Jobs for one worker."""

    run: str
    incarnation: str
    round: int

    def __post_init__(self) -> None:
        """Check that all speak of as many jobs, and of such that there are."""
        count = len(self.jobs)
        if not count or len(set(self.jobs.tolist())) < count:
            raise ValueError("no jobs, or one of them twice")
        if self.signs.shape != (count, 2) or self.seeds.shape != (count, 4):
            raise ValueError(f"signs of shape {self.signs.shape}, seeds of shape {self.seeds.shape} of {count} jobs")
        if not len(self.around) == len(self.rates) == len(self.explores) == count:
            raise ValueError("arrays over different jobs")
        if len(self.eps) != np.count_nonzero(self.explores):
            raise ValueError(f"{len(self.eps)} rows of eps of {np.count_nonzero(self.explores)} jobs")
        if not within(self.jobs, 0, 2**31) or not within(self.rates, 0, len(RATES)):
            raise ValueError("indices or rates out of range")
        if not within(self.signs, -1, 2) or np.count_nonzero(self.signs[:, 0]) < count:
            raise ValueError("signs other than 1 and -1")
        if not within(self.seeds, 0, 2**32):  # then some jobs' conditions are nominal
            nominal = (self.seeds == -1).all(axis=1)
            if not within(self.seeds[~nominal], 0, 2**32):
                raise ValueError("seeds out of range")

    @classmethod
    def carrying(cls, jobs: Jobs, *, run: str, incarnation: str, round: int) -> "Chunk":
        """At least one job, ready to send."""
        return cls(run=run, incarnation=incarnation, round=round, **vars(jobs))


_SIGNS: Final = ((1, -1), (1,), (-1,), (-1, 1), (1, 1), (-1, -1))

_NOMINAL: Final = (-1, -1, -1, -1)

_NO_EPS: Final = np.empty(0)
