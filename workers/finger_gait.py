"""Jobs of the finger gait: many rollouts at a time, and what a result says of them."""

from collections.abc import Sequence

import numpy as np

from farm.arrays import FloatArray
from farm.net.jobs import Job
from farm.net.results import Result, WireTrajectory
from farm.policies.fourier import Policy
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.physics import Rollouts, Simulation
from farm.tasks.finger_gait.task import SUBSTEPS, TIMESTEP, Frames, Perturbation, TaskConfig
from workers.jobs import parameters


class Gait:
    """Jobs of the finger gait."""

    def __init__(self, config: TaskConfig, policy: Policy) -> None:
        """Close the grips.

        Raises:
          ConfigError: as `Simulation`.
        """
        self._simulation = Simulation(config, policy)

    def run(self, mu: FloatArray, jobs: Sequence[Job]) -> list[Result]:
        """Run jobs around a mean (P,); results in the jobs' order."""
        results: dict[int, Result] = {}
        for rate in ("control", "physics"):
            chosen = [job for job in jobs if (job.rate == "physics") == (rate == "physics")]
            if chosen:
                results |= self._run(mu, chosen, 1 if rate == "physics" else SUBSTEPS)
        return [results[job.index] for job in jobs]

    def close(self) -> None:
        """Nothing to give back."""

    def _run(self, mu: FloatArray, jobs: Sequence[Job], substeps: int) -> dict[int, Result]:
        steps = self._simulation.task.config.steps
        theta, perturbations = [], []
        for job in jobs:
            seed = job.perturbation
            drawn = None if seed is None else Perturbation.draw(np.random.default_rng(seed), steps)
            theta.extend(parameters(mu, job))
            perturbations.extend([drawn] * len(job.signs))
        rollouts = self._simulation.run(np.stack(theta), perturbations, substeps)
        results, row = {}, 0
        for job in jobs:
            results[job.index] = result(self._simulation, job, rollouts, slice(row, row + len(job.signs)), substeps)
            row += len(job.signs)
        return results


def result(simulation: Simulation, job: Job, rollouts: Rollouts, rows: slice, substeps: int) -> Result:
    """What a job gave, whose rollouts are these rows, with a frame every so many physics steps."""
    outcome = rollouts.outcome
    images = outcome.images[rows]
    wanted = job.rate != "none"
    return Result(
        index=job.index,
        trajectory=WireTrajectory.of(trajectory(simulation, rollouts, rows.start, substeps)) if wanted else None,
        returns=outcome.returns[rows],
        success=outcome.success[rows],
        dropped=outcome.dropped[rows],
        failed=outcome.failed[rows],
        clamped=outcome.clamped[rows],
        traces=images.reshape(*images.shape[:2], images[0, 0].size).astype("<f4"),
    )


def trajectory(simulation: Simulation, rollouts: Rollouts, row: int, substeps: int) -> Trajectory:
    """One rollout, frame by frame, its moment of release first; a frame every so many physics steps."""
    outcome, parts = rollouts.outcome, SUBSTEPS // substeps
    frames = int(outcome.steps[row]) * parts
    control = np.repeat(np.arange(int(outcome.steps[row])), parts)
    shown = whole(rollouts, row, frames)
    images = tactile.image(shown.force, shown.place)
    terms = outcome.terms[row]
    return Trajectory(
        times=np.arange(frames + 1, dtype=float) * (TIMESTEP * substeps),
        bodies=simulation.scene.poses(shown.qpos),
        joints=shown.joints,
        targets=np.concatenate([simulation.task.commands[None], rollouts.targets[row][control]]),
        images=images,
        points=tactile.contact_points(images),
        terms=np.concatenate([np.zeros((1, terms.shape[1])), terms[control]]),
        value=float(outcome.returns[row]),
        success=bool(outcome.success[row]),
    )


def whole(rollouts: Rollouts, row: int, frames: int) -> Frames:
    """What was measured in one rollout: at its release, and in so many frames."""
    start, rest = rollouts.start, rollouts.frames
    return Frames(
        qpos=np.concatenate([start.qpos[row][None], rest.qpos[row, :frames]]),
        force=np.concatenate([start.force[row][None], rest.force[row, :frames]]),
        place=np.concatenate([start.place[row][None], rest.place[row, :frames]]),
    )
