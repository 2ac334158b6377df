"""The start of a run: task and policy from its configuration, its first state, and its workers'
specification.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm import fingerprint as fingerprints
from farm import plugins, seeds, settings
from farm.arrays import FloatArray
from farm.errors import CheckpointError, ConfigError
from farm.net.messages import Spec
from farm.policies.base import Policy, check_vector
from farm.policies.fourier import Kernel, Projected
from farm.runner import SIMULATION, Runner, build_policy, build_task, draw_constants
from farm.sim.model_files import Files, by_digest, split
from farm.sim.scene import Scene
from farm.tasks.base import Task, TaskSpec
from farm.tasks.probe import specification
from farm.tasks.rollouts import steps_shape
from farm.tasks.standard import nominal
from learner import algorithms
from learner.algorithms import SearchState
from learner.pool.round import Shapes
from learner.run import checkpoint as checkpoints
from learner.run import config as configs
from learner.run import hash_chain
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

MESSAGE_LIMIT: Final = 32 << 20
"""Largest size of a mean in a message [bytes]; a chunk also holds eps."""


@dataclass(frozen=True)
class Problem:
    """A run's search problem: parameters of a policy for a task."""

    config: RunConfig
    task: Task
    spec: TaskSpec
    policy: Policy

    @property
    def task_name(self) -> str:
        """The task's name, of a file without its folder."""
        return self._plugins["task"].wire

    @cached_property
    def scene(self) -> Scene:
        """The scene to draw."""
        return Scene.of(self.task.simulated)

    def shapes(self, *, steps: bool = False) -> Shapes:
        """What results look like; with `steps` traces of that kind."""
        spec = self.spec
        return Shapes(
            trace=steps_shape(spec) if steps else spec.trace_shape,
            frame=spec.shapes(len(self.scene.bodies)),
            observation=spec.observation,
            measures=len(spec.measures),
            substeps=self.task.substeps,
        )

    def specification(self, run: str) -> Spec:
        """The specification for workers."""
        config = self.config
        task, policy = self._plugins.values()
        texts, assets = split(self.task.sources)
        return Spec(
            run=run,
            task=task.wire,
            task_config=settings.to_dict(config.task_config),
            release=task.release,
            policy=policy.wire,
            policy_config=settings.to_dict(config.policy_config),
            policy_release=policy.release,
            task_release=self.spec.release,
            code=self.code,
            files=texts,
            assets=assets,
            constants=dict(self.policy.constants),
        )

    def runner(self) -> Runner:
        """Prepare simulation in this process; a ConfigError if the task cannot start."""
        return Runner(self.task, self.policy)

    @plugins.no_exit
    def begin(self) -> SearchState:
        """The algorithm's state before the first generation of a run that does not continue
        another.

        Raises:
          ConfigError: the policy's start is invalid; TaskError: the algorithm's state is.
        """
        size, mu = self.policy.size, self.policy.start(seeds.start(self.config.seed))
        check_vector(f"start of {self._plugins['policy'].wire}", mu, size)
        if mu is not None and self.policy.scale is not None:
            mu = mu / self.policy.scale
        return algorithms.begin(self.config.algorithm_of(), size, mu)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the problem's classes, which workers must be allowed to serve."""
        return tuple(
            dict.fromkeys(each.file for each in self._plugins.values() if each.file is not None)
        )

    @cached_property
    def sources(self) -> dict[str, bytes]:
        """Contents of `files` as they were imported, by SHA-256, for workers that accept code."""
        return {
            each.digest(): each.source for each in self._plugins.values() if each.file is not None
        }

    @property
    def assets(self) -> dict[str, bytes]:
        """Binary files of its models, by SHA-256."""
        return by_digest(self.task.sources)

    @cached_property
    def code(self) -> dict[str, str]:
        """Digests of the code that determines its numbers."""
        parts = {name: plugin.digest() for name, plugin in self._plugins.items()}
        return parts | {"simulation": plugins.code_digest(SIMULATION)}

    @cached_property
    def _plugins(self) -> dict[str, plugins.Plugin]:
        return {
            "task": plugins.find("tasks", self.config.task),
            "policy": plugins.find("policies", self.config.policy),
        }


@plugins.no_exit
def problem(
    config: RunConfig, constants: Mapping[str, FloatArray] | None = None, files: Files | None = None
) -> Problem:
    """Task and policy of a configuration, with a run's constants and files.

    By default new ones are drawn and read.

    Raises:
      ConfigError: the task is not available here, or the policy is larger than a message.
    """
    task = build_task(
        plugins.find("tasks", config.task), settings.to_dict(config.task_config), files
    )
    spec = specification(task)
    if config.stop_when_solved is not None and not spec.success:
        raise ConfigError(f"--stop-when-solved: {config.task} knows returns, but no success")
    plugin = plugins.find("policies", config.policy)
    if constants is None:
        constants = draw_constants(
            plugin, config.policy_config, task, spec, seeds.features(config.seed)
        )
    result = Problem(
        config, task, spec, build_policy(plugin, config.policy_config, spec, constants)
    )
    _check_size(result)
    return result


def _check_size(problem: Problem) -> None:
    """Check that a mean fits into a message.

    Raises:
      ConfigError: it does not; names the largest size that does.
    """
    size, most = problem.policy.size, MESSAGE_LIMIT // 8
    if size > most:
        raise ConfigError(f"the policy has {size} parameters; at most {most} fit into a message")
    constants = sum(values.nbytes for values in problem.policy.constants.values())
    if constants > MESSAGE_LIMIT:
        raise ConfigError(
            f"the policy's constants take {constants >> 20} MiB; at most {MESSAGE_LIMIT >> 20} fit"
            " into a message"
        )


def fitted(config: RunConfig, exponent: float = 1.0) -> RunConfig:
    """The configuration with the kernel's width h and the initial sigma computed, if --start is
    fitted.

    A Gaussian kernel of many numbers is zero nearly everywhere. With these values the initial mean
    mu has a small output at the nominal start x0 (d,), and a sample changes the exponent by about
    one:

        |mu - x0|^2 / (2 h^2) = exponent,   d sigma^2 / (2 h^2) = 1:    sigma = h sqrt(2 / d)

    Raises:
      ConfigError: policy or algorithm have no such settings, mu is x0, or the task is not available
          here.
    """
    if config.start != "fitted":
        return config
    kind = plugins.find("policies", config.policy).target
    policy: Any = config.policy_config
    algorithm: Any = config.algorithm_config
    if not issubclass(kind, Kernel | Projected):
        raise ConfigError(
            f"--start fitted is for the policies kernel and projected, not {config.policy}"
        )
    if not (hasattr(algorithm, "initial_mu") and hasattr(algorithm, "initial_sigma")):
        raise ConfigError(
            f"--start fitted needs --initial-mu and --initial-sigma, which {config.algorithm} does"
            " not have"
        )
    if config.init_from is not None:
        raise ConfigError(
            "--start fitted and --init-from exclude each other: both say where the search begins"
        )
    if policy.normalise:
        raise ConfigError(
            "--start fitted and --normalise exclude each other: both fit the kernel to the"
            " observation; give --no-normalise"
        )
    x0 = nominal(
        build_task(plugins.find("tasks", config.task), settings.to_dict(config.task_config), None)
    )
    difference = algorithm.initial_mu - x0
    bandwidth = float(np.sqrt((difference * difference).sum() / (2.0 * exponent)))
    if bandwidth == 0.0:
        raise ConfigError(
            "--start fitted: --initial-mu is the observation at the start; take another"
        )
    return replace(
        config,
        policy_config=replace(policy, bandwidth=bandwidth),
        algorithm_config=replace(
            algorithm, initial_sigma=bandwidth * float(np.sqrt(2.0 / len(x0)))
        ),
    )


def start(
    config: RunConfig, run: str, files: Files | None = None, fingerprint: str = ""
) -> tuple[Problem, Checkpoint]:
    """A run before its first generation.

    Args:
      config: of the run.
      run: its name.
      files: of its task; by default they are read.
      fingerprint: that of the machines that may take part, or how it begins; by default this
        machine's.

    Raises:
      ConfigError: the task is not available here, or the run to start from cannot be used.
    """
    result, state, moments = beginning(config, files)
    texts, assets = split(result.task.sources)
    checkpoint = Checkpoint(
        run=run,
        config=configs.to_dict(config),
        state=state.to_dict(),
        rollouts=0,
        reissued=0,
        seconds=0.0,
        solved=0,
        best=None,
        best_generation=0,
        fingerprint=fingerprint or fingerprints.digest(),
        replayed=True,
        code=result.code,
        files=texts,
        assets=assets,
        constants=dict(result.policy.constants),
        moments=moments,
        chain=hash_chain.first(config),
    )
    return result, checkpoint


def beginning(
    config: RunConfig,
    files: Files | None = None,
) -> tuple[Problem, SearchState, FloatArray]:
    """A run's problem, its first state, and the moments of observations with which it begins.

    Raises:
      ConfigError: the task is not available here, or the run to start from cannot be used.
    """
    origin = origin_of(config)
    if origin is None:
        result = problem(config, None, files)
        size = 1 + 2 * result.spec.observation if config.policy_config.normalise else 0
        return result, result.begin(), np.zeros(size)
    if origin.other_task:
        _check_sizes(config, origin, files)
    result = problem(config, origin.at.constants, files)
    return result, _taken_over(config, result.begin(), origin), origin.at.moments


def resumed(
    folder: RunFolder, config: RunConfig, fingerprint: str = "", *, any_rounding: bool = False
) -> tuple[Problem, Checkpoint]:
    """A run as saved in its checkpoint, or, if that has numbers of hosts expelled since, as it was
    before.

    Raises:
      CheckpointError: it cannot be used, belongs to another configuration, or the code that
        determines the run's numbers has changed and `any_rounding` does not allow it.
    """
    at = folder.states.without(checkpoints.load(folder.checkpoint))
    for name, old, new in configs.other(folder.config_of(at), config):
        raise CheckpointError(
            f"{folder.checkpoint} is of another configuration: --{name} is {old} there and {new} in"
            " config.json"
        )
    if not at.fingerprint.startswith(fingerprint):
        raise CheckpointError(
            f"--fingerprint {fingerprint}: the run in {folder.path} began with"
            f" {at.fingerprint}, and keeps it"
        )
    result = problem(config, at.constants, folder.files(at))
    if len(at.moments) != (
        1 + 2 * result.spec.observation if config.policy_config.normalise else 0
    ):
        raise CheckpointError(
            f"{folder.checkpoint}: its statistics are of other observations than its task's"
        )
    changed = [name for name, digest in result.code.items() if at.code.get(name) != digest]
    if changed and not any_rounding:
        raise CheckpointError(
            f"{folder.path}: the code of its {' and '.join(changed)} has changed since the run"
            f" began: put it back; or --resume {folder.path} --any-rounding keeps the optimiser's"
            " state and goes on with the new code (the run cannot be repeated then); or begin a new"
            " run from its mean with --init-from"
        )
    return result, at


@dataclass(frozen=True)
class Origin:
    """The run that another one begins from."""

    folder: RunFolder
    config: RunConfig
    """Configuration of the run that another one begins from."""
    at: Checkpoint
    heir: RunConfig
    """Configuration of the run that begins."""

    @property
    def other_task(self) -> bool:
        """Whether the origin has learnt another task than the run that begins."""
        return self.config.task != self.heir.task

    @property
    def scale_begins_anew(self) -> bool:
        """Whether the origin's sigma says nothing of the run that begins."""
        return self.other_task or self.heir.init_sigma == "fresh"

    @cached_property
    def problem(self) -> Problem:
        """Problem that the origin has learnt, as its class is today."""
        config = replace(self.config, stop_when_solved=None)
        return problem(config, self.at.constants, self.folder.files(self.at))


def origin_of(config: RunConfig) -> Origin | None:
    """The run that this one begins from, if there is one and its parameters have the same meaning.

    Raises:
      ConfigError: its policy is another one.
    """
    if config.init_from is None:
        return None
    try:
        folder = RunFolder.open(Path(config.init_from))
    except ConfigError as error:
        raise ConfigError(f"--init-from: {error}") from None
    try:
        other = folder.read_config()
    except ConfigError:  # its files are elsewhere, as those of another machine's run
        folder = replace(folder, allowed=configs.class_files(config))
        other = folder.read_config()
    for name in ("policy", "policy_config"):
        value, here = getattr(other, name), getattr(config, name)
        if value != here:
            raise ConfigError(
                f"--init-from {config.init_from}: its parameters mean something else ({value}, not"
                f" {here})"
            )
    return Origin(folder, other, checkpoints.load(folder.checkpoint), config)


def _check_sizes(config: RunConfig, origin: Origin, files: Files | None) -> None:
    """Check that the policy of one task can act in another.

    Raises:
      ConfigError: it cannot; names both sizes.
    """
    plugin = plugins.find("tasks", config.task)
    problem = origin.problem
    here = specification(build_task(plugin, settings.to_dict(config.task_config), files))
    for what in ("observation", "action"):
        new = getattr(here, what)
        old = getattr(problem.spec, what)
        if new != old:
            raise ConfigError(
                f"--init-from {config.init_from}: in its task {problem.task_name} an {what} has "
                f"{old} numbers, in {plugin.wire} {new}: its policy cannot act here"
            )


def handed_over(config: RunConfig) -> str:
    """What differs between a run's task and that of the run that it begins from, in a line.

    Empty if it begins from none, or from one of the same task.
    """
    origin = origin_of(config)
    if origin is None or not origin.other_task:
        return ""
    old = origin.problem
    new = beginning(config)[0]
    names = [each.task_name for each in (old, new)]
    if names[0] == names[1]:
        names = [origin.config.task, config.task]
    parts = [f"task {names[1]} (there {names[0]})", *_settings_that_differ(old, new)]
    sources = [each.task.sources for each in (old, new)]
    both = {**sources[0], **sources[1]}
    files = [name for name in both if sources[0].get(name) != sources[1].get(name)]
    parts += [f"files {', '.join(files)}"] if files else []
    observations = [[each.name for each in task.observations] for task in (old.task, new.task)]
    parts += [
        f"observation {i} {b!r} (there {a!r})"
        for i, (a, b) in enumerate(zip(*observations, strict=False))
        if a != b
    ]
    return f"begins with the mean of {config.init_from}; different here: {', '.join(parts)}"


def _settings_that_differ(old: Problem, new: Problem) -> list[str]:
    before, here = (settings.to_dict(each.config.task_config) for each in (old, new))
    return [
        f"{name.replace('_', '-')} {value}" + (f" (there {before[name]})" if name in before else "")
        for name, value in here.items()
        if name not in before or before[name] != value
    ]


def _taken_over(config: RunConfig, fresh: SearchState, origin: Origin) -> SearchState:
    """Start from another run's mean, and perhaps its sigma."""
    before = origin.at.state
    if len(before["mu"]) != len(fresh.mu):
        raise ConfigError(
            f"--init-from {config.init_from}: it has {len(before['mu'])} parameters, this run "
            f"{len(fresh.mu)}: its observation is another"
        )
    state = replace(fresh, mu=before["mu"])
    return state if origin.scale_begins_anew else state.spread(before["sigma"])
