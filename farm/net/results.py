"""What workers give back: returns, tactile traces, trajectories; or that a job failed. Pure, as `farm.net.messages`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.net.codec import array
from farm.sim.trajectory import Trajectory

_LINE: Final = 1000  # characters


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a job gave; R rollouts, one a sign. `Results` carries them."""

    index: int
    trajectory: "WireTrajectory | None"
    returns: FloatArray
    """(R,)"""
    success: BoolArray
    """(R,)"""
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

    How many rollouts a job has, and which have a trajectory or a trace, whoever gave the jobs knows (`traced`). A map
    for each job would take the learner ten times as long to read.
    """

    run: str
    incarnation: str
    round: int
    worker: str
    trajectories: "tuple[WireTrajectory, ...]"
    """Of the jobs that are seen, in their order."""
    jobs: IntArray = array("<i8", 1)
    """Indices, rising (J,)"""
    returns: FloatArray = array("<f8", 1)
    """(S,)"""
    flags: BoolArray = array("|b1", 2)
    """success, dropped, failed, clamped, (S, 4)"""
    traces: AnyArray = array("<f4", 3)
    """Tactile traces [N] that are wanted, (K, T, 54)"""

    def __post_init__(self) -> None:
        """Check that all speak of as many rollouts, at least one a job."""
        if not 1 <= len(self.jobs) <= len(self.returns):
            raise ValueError(f"{len(self.jobs)} jobs of {len(self.returns)} rollouts")
        jobs = self.jobs.tolist()
        if jobs != sorted(set(jobs)):
            raise ValueError("jobs that do not rise")
        if self.flags.shape != (len(self.returns), 4):
            raise ValueError(f"flags of shape {self.flags.shape} of {len(self.returns)} rollouts")

    @classmethod
    def of(
        cls, results: Sequence[Result], *, run: str, incarnation: str, round: int, worker: str, traces: str
    ) -> "Results":
        """Make at least one result ready to send, with those of its traces that are wanted, one of TRACES."""
        results = sorted(results, key=lambda result: result.index)
        returns = np.concatenate([r.returns for r in results])
        exploring = np.repeat([r.trajectory is None for r in results], [len(r.returns) for r in results])
        flags = [(r.success, r.dropped, r.failed, r.clamped) for r in results]
        return cls(
            run=run, incarnation=incarnation, round=round, worker=worker,
            trajectories=tuple(r.trajectory for r in results if r.trajectory),
            jobs=np.array([r.index for r in results]),
            returns=returns,
            flags=np.concatenate(flags, axis=1).T,
            traces=np.concatenate([r.traces for r in results])[traced(traces, returns, exploring)],
        )  # fmt: skip


def traced(traces: str, returns: FloatArray, exploring: BoolArray) -> IntArray:
    """Which rollouts of a message have a trace, rising (K,).

    Args:
      traces: one of TRACES.
      returns: (S,).
      exploring: which are of jobs that have no trajectory and so explore, (S,).
    """
    among = np.flatnonzero(exploring)
    if traces == "all":
        return among
    if traces == "none" or not among.size:
        return among[:0]
    theirs = returns[among]
    return among[sorted({int(theirs.argmax()), int(theirs.argmin())})]


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A job that could not be run: an exception, not a bad rollout. Or a worker that does not serve the run at all."""

    run: str
    incarnation: str
    round: int
    worker: str
    index: int | None
    """None where it is not the job: no job of this run can be run there."""
    error: str
    """One line."""

    def __post_init__(self) -> None:
        """Check that it can be shown."""
        if len(self.error) > _LINE or not self.error.isprintable():
            raise ValueError(f"an error of more than {_LINE} characters, or unprintable ones")


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
