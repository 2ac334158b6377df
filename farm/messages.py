"""What learner and workers say to each other. Pure: frozen dataclasses, bytes by `farm.codec`.

Everything is soft state: any message may be lost, doubled or late. Whatever belongs to work
carries (run, incarnation, round): the run's name, which start of its learner, which batch of jobs.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.codec import array
from farm.trajectory import Trajectory

RATES: Final = ("none", "control", "physics")
"""How much of a rollout a job wants to see, besides its figures: nothing, or a trajectory at that rate."""


@dataclass(frozen=True, kw_only=True)
class Want:
    """A worker's credits, worker to learners."""

    worker: str
    """<name>/<instance>"""
    credits: int
    """Jobs of one run it is willing to hold at a time."""
    idle: bool
    """It has had nothing to do for a while: what a learner believes it holds is lost."""
    version: str
    """Release of the worker's software."""
    assets: str
    """Digest of its hand and objects."""
    canary: str
    """Digest of the numbers its machine gives."""

    def __post_init__(self) -> None:
        """Check the number."""
        if not 0 <= self.credits <= 100_000:
            raise ValueError(f"{self.credits} credits")


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What a run simulates; told once, kept by workers under its digest. It names things, it never carries code."""

    run: str
    task: str
    """A name in TASKS."""
    task_config: dict[str, Any]
    policy_config: dict[str, Any]
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
    mu: FloatArray = array("<f8", 1)
    """(P,)"""
    sigma: FloatArray = array("<f8", 1)
    """(P,)"""


@dataclass(frozen=True, kw_only=True)
class Job:
    """Rollouts of origin + sign * eps for each sign, under one perturbation."""

    index: int
    origin: str
    """`mu`: the generation's mean; `zero`: eps are the parameters themselves."""
    signs: tuple[int, ...]
    """(1, -1) for a pair, (1,) for one rollout."""
    perturbation: tuple[int, ...] | None
    """Seed of the perturbation that all these rollouts share, None for nominal conditions."""
    rate: str
    """One of RATES."""
    eps: FloatArray = array("<f8", 1)
    """(P,), or (0,) for zeros"""

    def __post_init__(self) -> None:
        """Check names and signs."""
        if self.origin not in ("mu", "zero"):
            raise ValueError(f"a job around {self.origin!r}")
        if self.rate not in RATES or not 1 <= len(self.signs) <= 2 or not set(self.signs) <= {1, -1}:
            raise ValueError(f"a job of signs {self.signs} and rate {self.rate!r}")
        if not 0 <= self.index < 2**31 or any(not 0 <= s < 2**64 for s in self.perturbation or ()):
            raise ValueError(f"a job of index {self.index} and perturbation {self.perturbation}")


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """Jobs for one worker."""

    run: str
    incarnation: str
    round: int
    jobs: tuple[Job, ...]


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a job gave; R rollouts, one a sign."""

    index: int
    trajectory: "WireTrajectory | None"
    returns: FloatArray = array("<f8", 1)
    """(R,)"""
    success: BoolArray = array("|b1", 1)
    """(R,)"""
    steps: IntArray = array("<i8", 1)
    """Control steps until the end, (R,)"""
    dropped: BoolArray = array("|b1", 1)
    """(R,)"""
    failed: BoolArray = array("|b1", 1)
    """(R,)"""
    clamped: BoolArray = array("|b1", 1)
    """(R,)"""
    traces: AnyArray = array("<f4", 3)
    """Tactile traces [N], (R, T, 54), zero after the end."""

    def __post_init__(self) -> None:
        """Check that all speak of as many rollouts."""
        sizes = {len(a) for a in (self.returns, self.success, self.steps, self.dropped, self.failed, self.clamped)}
        if sizes != {len(self.traces)} or not 1 <= len(self.traces) <= 2:
            raise ValueError("arrays of different lengths")


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a chunk gave, worker to learner."""

    run: str
    incarnation: str
    round: int
    worker: str
    results: tuple[Result, ...]


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that could not be run: an exception, not a bad rollout."""

    run: str
    incarnation: str
    round: int
    worker: str
    index: int
    error: str


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """Why a run gives a worker no jobs, learner to worker."""

    run: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class WorkerStatus:
    """How a worker is doing, as a learner sees it."""

    worker: str
    version: str
    canary: str
    rollouts: int
    """It has brought so many."""
    rate: float
    """Rollouts a second, over the last ten."""
    seen: float
    """Since it was last heard of [s]."""


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """How a run is doing, answered by its learner."""

    run: str
    generation: int
    generations: int
    return_mean: float | None
    mean_policy_return: float | None
    open: int
    """Jobs of this round that are not done."""
    reissued: int
    refused: int
    """Workers that were refused."""
    ignored: dict[str, Any]
    """Messages that did not count, by kind."""
    workers: tuple[WorkerStatus, ...]


@dataclass(frozen=True, kw_only=True)
class WireTrajectory:
    """A Trajectory on its way; float32 but for times and figures."""

    value: float
    success: bool
    times: FloatArray = array("<f8", 1)
    bodies: AnyArray = array("<f4", 3)
    joints: AnyArray = array("<f4", 2)
    targets: AnyArray = array("<f4", 2)
    images: AnyArray = array("<f4", 3)
    points: AnyArray = array("<f4", 3)
    terms: AnyArray = array("<f4", 2)

    def __post_init__(self) -> None:
        """Check that all have as many frames, and each its width."""
        frames = len(self.times)
        widths = (("bodies", (7,)), ("joints", (8,)), ("targets", (8,)), ("images", (3, 18)), ("points", (3, 3)))
        for name, width in (*widths, ("terms", (5,))):
            shape = getattr(self, name).shape
            if shape[0] != frames or shape[-len(width) :] != width:
                raise ValueError(f"{name} of shape {shape} in {frames} frames")

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
