"""Loads a run's policy and rolls it out again, under the trained or other settings of its task.

import farm

policy = farm.load("runs/first", friction=0.5)
print(policy.rollout().trajectory.success)
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from farm import plugins, settings
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.moments import normaliser_of
from farm.policies.normalised import Normalised
from farm.runner import Runner, build_task
from farm.seeds import numbered_start
from farm.sim.model_files import Content, Files
from farm.sim.trajectory import Trajectory
from farm.tasks.loop import Acting
from farm.tasks.rollouts import Rollouts, Seed, whole
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.folder import RunFolder, opened
from learner.run.setup import Problem

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Replay:
    """A repeated rollout at physics rate."""

    trajectory: Trajectory
    frames: Mapping[str, FloatArray]
    """Measured values of each frame, including qpos (F, nq)"""
    rollouts: Rollouts
    """One row."""


@dataclass(frozen=True)
class LoadedPolicy:
    """The mean policy of a run after some generation."""

    problem: Problem
    generation: int
    """Number of updates before it."""
    mu: FloatArray
    """The search's mean, (P,)"""

    @cached_property
    def runner(self) -> Runner:
        """Simulates it in this process."""
        return self.problem.runner()

    @property
    def parameters(self) -> FloatArray:
        """The policy's parameters, (P,): mu, times the policy's scale if it has one."""
        scale = self.problem.policy.scale
        return self.mu if scale is None else scale * self.mu

    def acting(self, count: int = 1) -> Acting:
        """Return the policy as it acts in this number of rollouts, with their memories."""
        return Acting(self.problem.policy, np.repeat(self.mu[None], count, axis=0))

    def rollout(self, theta: FloatArray | None = None, seed: Seed | int = None) -> Replay:
        """Simulate one rollout of the policy, or of other parameters (P,), from the start for a
        seed (None: nominal).

        A number is the start of `farm evaluate` with this number.

        Raises:
          ConfigError: there is no such start, or these are no P finite numbers.
        """
        parameters = self.mu if theta is None else self._checked(theta, self.mu.shape)
        start = seed if seed is None or isinstance(seed, tuple) else numbered_start(seed)
        return self.rollouts(parameters[None], [start])[0]

    def _checked(self, theta: object, shape: tuple[int, ...]) -> FloatArray:
        """Parameters of somebody else's, of this shape."""
        expected = f"expected finite numbers of shape {shape}"
        try:
            array = np.asarray(theta, dtype=np.float64)
        except (TypeError, ValueError):
            raise ConfigError(f"theta is a {type(theta).__name__}; {expected}") from None
        if array.shape != shape:
            raise ConfigError(f"theta has shape {array.shape}; {expected}")
        if not np.isfinite(array).all():
            raise ConfigError(f"theta is not finite; {expected}")
        return array

    def rollouts(self, theta: FloatArray, seeds: Sequence[Seed]) -> list[Replay]:
        """Rollouts of parameters (B, P), from the starts for their seeds.

        Raises:
          ConfigError: these are not P finite numbers for each seed.
        """
        parameters = self._checked(theta, (len(seeds), self.mu.size))
        batch = self.runner.rollouts(parameters, list(seeds), physics=True)
        rows = range(len(seeds))
        return [
            Replay(self.runner.trajectory(batch, i), whole(batch, i), batch.at(slice(i, i + 1)))
            for i in rows
        ]


def load(
    path: str | Path,
    generation: int | None = None,
    *,
    last: bool = False,
    allow_file: str | Path | None = None,
    **changed: Any,  # noqa: ANN401
) -> LoadedPolicy:
    """The policy of the run in a folder, or its mean policy after a generation, with other settings
    of its task.

    With `last` it is the policy after the last generation, though a validated one is better.

    `allow_file` is a file with the class of a run that somebody else made.

    Raises:
      ConfigError: it is not stored, or cannot be simulated like that.

    Example:
      ```python
      import farm

      policy = farm.load("runs/first", friction=0.5)
      trajectory = policy.rollout(seed=3).trajectory
      # return, success, duration [s]
      print(trajectory.value, trajectory.success, trajectory.times[-1])
      assert trajectory.bodies.shape[2] == 7  # (F, bodies, 7): position [m] and quaternion
      ```
    """
    if last and generation is not None:
        raise ConfigError("generation and last exclude each other: give one of the two")
    folder = opened(path, allow_file)
    config = folder.read_config()
    try:
        task = replace(config.task_config, **changed)
    except TypeError:
        raise ConfigError(f"no settings of {config.task}: {', '.join(changed)}") from None
    return loaded(folder, generation, task, last=last)


def loaded(
    folder: RunFolder,
    generation: int | None = None,
    task: Any = None,  # noqa: ANN401
    average: int | None = None,
    *,
    last: bool = False,
) -> LoadedPolicy:
    """Load a policy like `load`, with all settings of the task in one object, and the average of
    this number of last means.

    With `average` the means are the last ones, or those up to `generation`, of which without it
    there is one.

    Raises:
      ConfigError: it is not stored, or cannot be simulated like that.
    """
    if generation is not None and type(generation) is not int:
        raise ConfigError(f"generation is {generation!r:.40}; expected a whole number")
    at = checkpoints.load(folder.checkpoint)
    if generation is None and average is None:
        number, mu, normaliser = policy_of(folder, at, last=last)
    else:
        number, mu, normaliser = _last(at) if generation is None else _after(folder, at, generation)
        mu = folder.parameters.average(number, mu, average or 1)
    return LoadedPolicy(seeing(restored(folder, at, task), normaliser), number, mu)


def policy_of(
    folder: RunFolder, at: Checkpoint, *, last: bool = False
) -> tuple[int, FloatArray, FloatArray]:
    """A run's policy: its generation, mean (P,) and normaliser (2, d) or (2, 0).

    It is the best validated one, or with `last`, and where no other is better, the last one: the
    average of as many means as the run says.
    """
    if not last and (better := at.better) is not None:
        return better.generation, better.mu, better.normaliser
    number, mu, normaliser = _last(at)
    return number, folder.parameters.average(number, mu, folder.read_config().average), normaliser


def restored(folder: RunFolder, at: Checkpoint, task: Any = None) -> Problem:  # noqa: ANN401
    """A run's problem from its checkpoint, with all settings of the task in one object; None for
    the run's own.

    Raises:
      ConfigError: it cannot be simulated like that.
    """
    config, files = folder.read_config(), folder.files(at)
    if task is not None and task != config.task_config:
        files = _files(config, replace(config, task_config=task), files)
        config = replace(config, task_config=task)
    problem = setup.problem(replace(config, stop_when_solved=None), at.constants, files)
    if changed := [name for name in ("task", "policy") if at.code.get(name) != problem.code[name]]:
        log.warning(
            "%s: the code of its %s has changed since the run began; these are the numbers of the"
            " present code",
            folder.path,
            " and ".join(changed),
        )
    return problem


def seeing(problem: Problem, normaliser: FloatArray) -> Problem:
    """The problem with the policy's observations normalised by (2, d); unchanged if d is 0."""
    return (
        replace(problem, policy=Normalised(problem.policy, normaliser))
        if normaliser.size
        else problem
    )


def _files(old: RunConfig, new: RunConfig, files: Files) -> dict[str, Content]:
    """Files of a task with other settings: the run's own, except those that depend on the
    settings.
    """
    plugin = plugins.find("tasks", old.task)
    before, after = (
        dict(build_task(plugin, settings.to_dict(c.task_config), None).sources) for c in (old, new)
    )
    return {
        name: files[name] if name in files and text == before.get(name) else text
        for name, text in after.items()
    }


def _last(at: Checkpoint) -> tuple[int, FloatArray, FloatArray]:
    """The last generation, its mean and its normaliser."""
    return int(at.state["generation"]), at.state["mu"], normaliser_of(at.moments)


def _after(
    folder: RunFolder, at: Checkpoint, generation: int
) -> tuple[int, FloatArray, FloatArray]:
    """A generation, its mean and its normaliser.

    Those of generation 0 follow from the configuration.
    """
    if generation == int(at.state["generation"]):
        return _last(at)
    if generation != 0:
        return generation, *folder.parameters.mean(generation)
    config = folder.read_config()
    if config.init_from is not None:
        raise ConfigError(
            f"generation 0 is the policy of the run in {config.init_from}: give that run"
        )
    first = setup.start(config, folder.name, folder.files(at))[1]
    return 0, first.state["mu"], normaliser_of(first.moments)
