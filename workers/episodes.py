"""Jobs of tasks that are simulated one rollout at a time, and that have no fingers and know no success."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from farm import tasks
from farm.arrays import FloatArray
from farm.net.jobs import Job
from farm.net.results import Result, WireTrajectory
from farm.policies.fourier import Policy
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait.task import TaskConfig
from farm.tasks.finger_gait.touch import TAXELS
from workers.jobs import parameters


@dataclass(frozen=True)
class Episode:
    """A rollout that is over."""

    value: float
    """Discounted sum of its rewards; RETURN_FLOOR where it failed."""
    failed: bool
    """Whether the physics blew up."""
    qpos: FloatArray
    """Positions at the reset and after each control step, (F, nq)."""
    actions: FloatArray
    """Between the environment's limits, (F - 1, A)."""
    rewards: FloatArray
    """(F - 1,)"""


class Episodes(ABC):
    """Runs one run's jobs, episode by episode."""

    def __init__(self, config: TaskConfig, policy: Policy, scene: Scene) -> None:
        """Keep what every episode needs."""
        self.policy, self.scene = policy, scene
        self.gamma, self.sizes = config.gamma, tasks.sizes(config)

    @abstractmethod
    def episode(self, theta: FloatArray, perturbation: tuple[int, ...] | None) -> Episode:
        """One rollout of a controller (P,), from the start that a perturbation's seed gives."""

    def close(self) -> None:  # noqa: B027  most tasks hold nothing
        """Give back what it holds: nothing, unless a task says otherwise."""

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Run jobs around a mean (P,); results in the jobs' order."""
        return [self._result(mu, job) for job in jobs]

    def _result(self, mu: FloatArray, job: Job) -> Result:
        episodes = [self.episode(theta, job.perturbation) for theta in parameters(mu, job)]
        failed, no = np.array([e.failed for e in episodes]), np.zeros(len(episodes), dtype=bool)
        return Result(
            index=job.index,
            trajectory=None if job.rate == "none" else WireTrajectory.of(self._trajectory(episodes[0])),
            returns=np.array([e.value for e in episodes]),
            success=no,
            dropped=no,
            failed=failed,
            clamped=failed,
            traces=np.zeros((len(episodes), 0, TAXELS * 3), dtype="<f4"),
        )

    def _trajectory(self, episode: Episode) -> Trajectory:
        """Frame by frame, at control rate whichever was asked for: no physics steps are kept."""
        frames = len(episode.qpos)
        return Trajectory(
            times=np.arange(frames, dtype=float) * self.sizes.period,
            bodies=self.scene.poses(episode.qpos),
            joints=np.empty((frames, 0)),
            targets=np.concatenate([np.zeros((1, len(self.sizes.lower))), episode.actions]),
            images=np.empty((frames, 0, TAXELS)),
            points=np.empty((frames, 0, 3)),
            terms=np.append(0.0, episode.rewards)[:, None],
            value=episode.value,
            success=None,
        )
