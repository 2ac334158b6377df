"""What learner and workers say to each other. Pure: frozen dataclasses, bytes by `farm.codec`.

Everything is soft state: any message may be lost, doubled or late. Whatever belongs to work
carries (run, incarnation, round): the run's name, which start of its learner, which batch of jobs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.codec import array
from farm.trajectory import Trajectory

_SHORT: Final = 250  # characters; names have up to 100, a worker's is two of them
_LINE: Final = 1000  # characters

RATES: Final = ("none", "control", "physics")
"""How much of a rollout a job wants to see, besides its figures: nothing, or a trajectory at that rate."""


@dataclass(frozen=True, kw_only=True)
class Want:
    """A worker's credits, worker to learners."""

    worker: str
    """<name>/<instance>"""
    credits: int
    """Jobs of one run it is willing to hold at a time."""
    idle: tuple[str, ...]
    """Runs that it holds nothing of, and has not for a while: what their learners believe it holds is lost."""
    version: str
    """Release of the worker's software."""
    assets: str
    """Digest of its hand and objects."""
    canary: str
    """Digest of the numbers its machine gives."""
    host: str
    cores: int
    """That its machine has."""

    def __post_init__(self) -> None:
        """Check the number, and that what is remembered of a worker is short."""
        for said in (self.worker, self.version, self.assets, self.canary, self.host):
            if len(said) > _SHORT or not said.isprintable():
                raise ValueError(f"a name of more than {_SHORT} characters, or unprintable ones")
        if not 0 <= self.credits <= 100_000:
            raise ValueError(f"{self.credits} credits")


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What a run simulates; told once, kept by workers under its digest. It names things, it never carries code."""

    run: str
    task: str
    """finger-gait, or gym:NAME."""
    task_config: dict[str, Any]
    policy_config: dict[str, Any]
    release: str = ""
    """Of the package that the task comes from, empty for the farm's own."""
    frequencies: FloatArray = array("<f8", 2)
    """Random features W, (D, d)"""
    phases: FloatArray = array("<f8", 1)
    """Random features c, (D,)"""


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
        if self.signs.shape != (count, 2) or self.seeds.shape != (count, 4):
            raise ValueError(f"signs of shape {self.signs.shape}, seeds of shape {self.seeds.shape} of {count} jobs")
        if not len(self.around) == len(self.rates) == len(self.explores) == count:
            raise ValueError("arrays over different jobs")
        if len(self.eps) != np.count_nonzero(self.explores):
            raise ValueError(f"{len(self.eps)} rows of eps of {np.count_nonzero(self.explores)} jobs")
        if not _within(self.jobs, 0, 2**31) or not _within(self.rates, 0, len(RATES)):
            raise ValueError("indices or rates out of range")
        if not _within(self.signs, -1, 2) or np.count_nonzero(self.signs[:, 0]) < count:
            raise ValueError("signs other than 1 and -1")
        if not _within(self.seeds, 0, 2**32):  # then some jobs' conditions are nominal
            nominal = (self.seeds == -1).all(axis=1)
            if not _within(self.seeds[~nominal], 0, 2**32):
                raise ValueError("seeds out of range")

    @classmethod
    def carrying(cls, jobs: Jobs, *, run: str, incarnation: str, round: int) -> "Chunk":
        """At least one job, ready to send."""
        return cls(run=run, incarnation=incarnation, round=round, **vars(jobs))


_SIGNS: Final = ((1, -1), (1,), (-1,), (-1, 1), (1, 1), (-1, -1))
_NOMINAL: Final = (-1, -1, -1, -1)
_NO_EPS: Final = np.empty(0)


def _within(values: IntArray, least: int, end: int) -> bool:
    if values.size < _FEW:
        listed = values.ravel().tolist()
        return not listed or (min(listed) >= least and max(listed) < end)
    return bool(values.min() >= least and values.max() < end)


def _rising(values: IntArray) -> bool:
    listed = values.tolist()
    return listed == sorted(set(listed))


_FEW: Final = 100  # values: with fewer, Python is quicker than NumPy


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a job gave; R rollouts, one a sign. `Results` carries them."""

    index: int
    trajectory: "WireTrajectory | None"
    returns: FloatArray
    """(R,)"""
    success: BoolArray
    """(R,)"""
    steps: IntArray
    """Control steps until the end, (R,)"""
    dropped: BoolArray
    """(R,)"""
    failed: BoolArray
    """(R,)"""
    clamped: BoolArray
    """(R,)"""
    traces: AnyArray
    """Tactile traces [N], (R, T, 54) float32, zero after the end; (R, 0, 54) where there are none."""


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a chunk gave, worker to learner: one array of each kind over the rollouts of all its jobs.

    A map for each job would take the learner ten times as long to read.
    """

    run: str
    incarnation: str
    round: int
    worker: str
    trajectories: "tuple[WireTrajectory, ...]"
    """Of the jobs that are seen, in their order."""
    jobs: IntArray = array("<i8", 1)
    """Indices, rising (J,)"""
    rollouts: IntArray = array("<i8", 1)
    """Of each job, (J,), S in all"""
    seen: BoolArray = array("|b1", 1)
    """Which jobs have a trajectory, (J,)"""
    returns: FloatArray = array("<f8", 1)
    """(S,)"""
    steps: IntArray = array("<i8", 1)
    """(S,)"""
    flags: BoolArray = array("|b1", 2)
    """success, dropped, failed, clamped, (S, 4)"""
    traced: IntArray = array("<i8", 1)
    """Which rollouts have a trace here, rising (K,)"""
    traces: AnyArray = array("<f4", 3)
    """(K, T, 54)"""

    def __post_init__(self) -> None:
        """Check that all speak of as many jobs and rollouts."""
        if not len(self.jobs) == len(self.rollouts) == len(self.seen) >= 1:
            raise ValueError("no jobs, or arrays over different ones")
        if not _rising(self.jobs) or not _within(self.rollouts, 1, 3):
            raise ValueError("jobs that do not rise, or of other than one or two rollouts")
        count = self.rollouts.sum()
        if not len(self.returns) == len(self.steps) == count or self.flags.shape != (count, 4):
            raise ValueError("arrays over different rollouts")
        rising = _within(self.traced, 0, count) and _rising(self.traced)
        if len(self.traced) != len(self.traces) or not rising:
            raise ValueError(f"{len(self.traces)} traces of {len(self.traced)} rollouts, which do not rise")
        if len(self.trajectories) != np.count_nonzero(self.seen):
            raise ValueError(f"{len(self.trajectories)} trajectories of {np.count_nonzero(self.seen)} jobs")

    @classmethod
    def of(
        cls, results: Sequence[Result], *, run: str, incarnation: str, round: int, worker: str, traces: str
    ) -> "Results":
        """Make at least one result ready to send, with those of its traces that are wanted, one of TRACES."""
        results = sorted(results, key=lambda result: result.index)
        returns = np.concatenate([r.returns for r in results])
        seen = np.array([r.trajectory is not None for r in results])
        rollouts = np.array([len(r.returns) for r in results])
        felt = traced(traces, returns, rollouts, seen)
        flags = [(r.success, r.dropped, r.failed, r.clamped) for r in results]
        return cls(
            run=run, incarnation=incarnation, round=round, worker=worker,
            trajectories=tuple(r.trajectory for r in results if r.trajectory),
            jobs=np.array([r.index for r in results]),
            rollouts=rollouts,
            seen=seen,
            returns=returns,
            steps=np.concatenate([r.steps for r in results]),
            flags=np.concatenate(flags, axis=1).T,
            traced=felt,
            traces=np.concatenate([r.traces for r in results])[felt],
        )  # fmt: skip


TRACES: Final = ("none", "extremes", "all")
"""Tactile traces that results bring: none, of the best and the worst exploring rollout of each message, of all of them.

The best rollout of a round (of equals the first) is the best of the message that brings it: with `extremes` its trace
is never missed, whichever jobs travel together.
"""


def traced(traces: str, returns: FloatArray, rollouts: IntArray, seen: BoolArray) -> IntArray:
    """Which rollouts of a message have a trace, rising (K,).

    Args:
      traces: one of TRACES.
      returns: (S,).
      rollouts: of each job, (J,), S in all.
      seen: which jobs have a trajectory and so do not explore, (J,).
    """
    exploring = np.flatnonzero(~np.repeat(seen, rollouts))
    if traces == "all":
        return exploring
    if traces == "none" or not exploring.size:
        return exploring[:0]
    theirs = returns[exploring]
    return exploring[sorted({int(theirs.argmax()), int(theirs.argmin())})]


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that could not be run: an exception, not a bad rollout."""

    run: str
    incarnation: str
    round: int
    worker: str
    index: int
    error: str
    """One line."""

    def __post_init__(self) -> None:
        """Check that it can be shown."""
        if len(self.error) > _LINE or not self.error.isprintable():
            raise ValueError(f"an error of more than {_LINE} characters, or unprintable ones")


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a run gives a worker no jobs, learner to worker."""

    run: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class WireTrajectory:
    """A Trajectory on its way; float32 but for times and figures."""

    value: float
    success: bool | None
    times: FloatArray = array("<f8", 1)
    bodies: AnyArray = array("<f4", 3)
    joints: AnyArray = array("<f4", 2)
    targets: AnyArray = array("<f4", 2)
    images: AnyArray = array("<f4", 3)
    points: AnyArray = array("<f4", 3)
    terms: AnyArray = array("<f4", 2)

    def __post_init__(self) -> None:
        """Check that all have as many frames, at rising times; how wide each is, the run's task says."""
        if not len(self.times) or self.times[0] != 0.0 or (np.diff(self.times) <= 0.0).any():
            raise ValueError(f"{len(self.times)} frames that do not begin at 0 and rise")
        for name in ("bodies", "joints", "targets", "images", "points", "terms"):
            shape = getattr(self, name).shape
            if shape[0] != len(self.times):
                raise ValueError(f"{name} of shape {shape} in {len(self.times)} frames")

    def fits(self, shapes: Mapping[str, tuple[int, ...]]) -> bool:
        """Whether a frame of each array has the shape that the run's task says."""
        return all(getattr(self, name).shape[1:] == shape for name, shape in shapes.items())

    @classmethod
    def of(cls, trajectory: Trajectory) -> "WireTrajectory":
        """Make ready to send."""
        shrink = {
            name: np.clip(np.nan_to_num(getattr(trajectory, name), nan=-1e30), -1e30, 1e30).astype("<f4")
            for name in ("bodies", "joints", "targets", "images", "points", "terms")
        }
        return cls(value=trajectory.value, success=trajectory.success, times=trajectory.times, **shrink)

    def trajectory(self) -> Trajectory:
        """As it was, to float32's precision."""
        grow = {name: getattr(self, name).astype(float) for name in ("bodies", "joints", "targets", "images")}
        return Trajectory(
            times=self.times,
            **grow,
            points=self.points.astype(float),
            terms=self.terms.astype(float),
            value=self.value,
            success=self.success,
        )
