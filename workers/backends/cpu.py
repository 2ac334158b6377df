"""Jobs on this machine's processor: one thread, many rollouts at a time in mujoco.batch."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from farm import tactile
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.messages import Job, Result, Spec, WireTrajectory
from farm.policy import Features, Policy, PolicyConfig
from farm.states import STATES
from farm.tasks import TASKS
from farm.tasks.finger_gait import SUBSTEPS, TIMESTEP, Perturbation, TaskConfig
from farm.trajectory import Trajectory
from workers.simulation import CAPACITY, Rollouts, Simulation


class CpuBackend:
    """Simulates one run's jobs."""

    capacity: ClassVar[int] = CAPACITY
    """Jobs that are worth holding at a time."""

    def __init__(self, spec: Spec) -> None:
        """Build the run's task from its specification.

        Raises:
          ConfigError: it names something this release does not know.
        """
        if spec.task not in TASKS:
            raise ConfigError(f"unknown task {spec.task!r}; known are {', '.join(TASKS)}")
        try:
            config, policy = TaskConfig(**spec.task_config), PolicyConfig(**spec.policy_config)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"a specification that this release does not understand: {error}") from None
        features = Features(frequencies=spec.frequencies, phases=spec.phases)
        size = STATES[config.state].size
        if spec.frequencies.shape != (len(spec.phases), size):
            raise ConfigError(f"features of shape {spec.frequencies.shape} for {size} state components")
        self._simulation = Simulation(config, Policy(policy, size, features))

    @property
    def parameters(self) -> int:
        """Length P of a parameter vector."""
        return self._simulation.policy.size

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
            results[job.index] = self._result(job, rollouts, slice(row, row + len(job.signs)), substeps)
            row += len(job.signs)
        return results

    def _result(self, job: Job, rollouts: Rollouts, rows: slice, substeps: int) -> Result:
        outcome = rollouts.outcome
        images = outcome.images[rows]
        wanted = job.rate != "none"
        return Result(
            index=job.index,
            trajectory=WireTrajectory.of(self._trajectory(rollouts, rows.start, substeps)) if wanted else None,
            returns=outcome.returns[rows],
            success=outcome.success[rows],
            steps=outcome.steps[rows].astype("<i8"),
            dropped=outcome.dropped[rows],
            failed=outcome.failed[rows],
            clamped=outcome.clamped[rows],
            traces=images.reshape(*images.shape[:2], -1).astype("<f4"),
        )

    def _trajectory(self, rollouts: Rollouts, row: int, substeps: int) -> Trajectory:
        """One rollout, frame by frame, its moment of release first."""
        outcome, parts = rollouts.outcome, SUBSTEPS // substeps
        frames = int(outcome.steps[row]) * parts
        control = np.repeat(np.arange(int(outcome.steps[row])), parts)
        qpos = np.concatenate([rollouts.start.qpos[row][None], rollouts.frames.qpos[row, :frames]])
        force = np.concatenate([rollouts.start.force[row][None], rollouts.frames.force[row, :frames]])
        place = np.concatenate([rollouts.start.place[row][None], rollouts.frames.place[row, :frames]])
        images = tactile.image(force, place)
        terms = outcome.terms[row]
        return Trajectory(
            times=np.arange(frames + 1, dtype=float) * (TIMESTEP * substeps),
            bodies=self._simulation.scene.poses(qpos),
            joints=qpos[:, :8],
            targets=np.concatenate([self._simulation.task.commands[None], rollouts.targets[row][control]]),
            images=images,
            points=tactile.contact_points(images),
            terms=np.concatenate([np.zeros((1, terms.shape[1])), terms[control]]),
            value=float(outcome.returns[row]),
            success=bool(outcome.success[row]),
        )


def parameters(mu: FloatArray, job: Job) -> list[FloatArray]:
    """The parameter vectors (P,) of a job's rollouts, one a sign."""
    origin = mu if job.origin == "mu" else np.zeros_like(mu)
    return [origin + sign * job.eps if job.eps.size else origin for sign in job.signs]
