"""What a finished run is good for: a policy that it stored, again, under the trained or other conditions.

from learner.replay import Conditions, again
from learner.run_folder import RunFolder

print(again(RunFolder.open(Path("runs/first")), Conditions(friction=0.5)).trajectory.success)
"""

from dataclasses import dataclass, replace

import numpy as np
from farm.tasks.finger_gait.physics import Rollouts, Simulation
from workers.finger_gait import trajectory, whole

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.policies.fourier import Features, Policy
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait.hand import JOINTS
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.task import Frames, Perturbation
from learner import checkpoint as checkpoints
from learner.config import RunConfig
from learner.run_folder import RunFolder
from learner.setup import start


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What is different from the run's own nominal conditions."""

    object: str | None = None
    """Object to hold: the name of a file in assets/objects; None: the run's."""
    friction: float | None = None
    """Factor of every friction coefficient, of fingertips and object alike; None: 1."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.friction is not None and not 0 < self.friction < np.inf:
            raise ConfigError(f"friction is {self.friction}; expected a positive number")

    def __str__(self) -> str:
        """As a caption says it; empty for the run's own."""
        said = [] if self.object is None else [f"object {self.object}"]
        return ", ".join([*said, *([] if self.friction is None else [f"friction times {self.friction:g}"])])

    def perturbation(self, steps: int) -> Perturbation | None:
        """As the simulation takes it."""
        if self.friction is None:
            return None
        return Perturbation(self.friction, 1.0, np.zeros(3), np.zeros((steps, len(JOINTS))))


@dataclass(frozen=True)
class Stored:
    """A policy that a run stored, ready to simulate."""

    config: RunConfig
    generation: int
    """Updates that led to it."""
    mu: FloatArray
    """Its parameters, (P,)"""
    features: Features
    simulation: Simulation


@dataclass(frozen=True)
class Again:
    """A rollout of a stored policy, at physics rate."""

    stored: Stored
    rollouts: Rollouts
    """One row."""
    trajectory: Trajectory

    @property
    def frames(self) -> Frames:
        """(F,) what was measured, at the release and after each physics step until the end."""
        return whole(self.rollouts, 0, len(self.trajectory.times) - 1)


def stored(folder: RunFolder, generation: int | None = None, object_name: str | None = None) -> Stored:
    """The mean policy after a generation, None for the last.

    Raises:
      ConfigError: it is not stored, its grips do not hold this object, or it is of another task.
    """
    config = folder.read_config()
    if config.task.kind != "finger-gait":
        raise ConfigError(f"{folder.path} has learnt {config.task.task}: this is for runs of finger-gait alone")
    at = checkpoints.load(folder.checkpoint)
    last = int(at.state["generation"])
    chosen = last if generation is None else generation
    mu = at.state["mu"] if chosen == last else _earlier(folder, config, chosen)
    features = Features(at.frequencies, at.phases)
    policy = Policy(config.policy, STATES[config.task.state].size, features)
    task = config.task if object_name is None else replace(config.task, object=object_name)
    return Stored(config, chosen, mu, features, Simulation(task, policy))


def again(folder: RunFolder, conditions: Conditions | None = None, generation: int | None = None) -> Again:
    """Simulate a stored policy once more.

    Raises:
      ConfigError: the policy is not stored, or the grips do not hold the object.
    """
    conditions = conditions or Conditions()
    policy = stored(folder, generation, conditions.object)
    simulation = policy.simulation
    perturbation = conditions.perturbation(simulation.task.config.steps)
    rollouts = simulation.run(policy.mu[None], [perturbation], substeps=1)
    return Again(policy, rollouts, trajectory(simulation, rollouts, 0, 1))


def _earlier(folder: RunFolder, config: RunConfig, generation: int) -> FloatArray:
    """A mean before the checkpoint's; that of generation 0 follows from the configuration."""
    if generation != 0:
        return folder.mean(generation)
    if config.init_from is not None:
        raise ConfigError(f"generation 0 is the policy of the run in {config.init_from}: give that run")
    mu: FloatArray = start(config, folder.name).state["mu"]
    return mu
