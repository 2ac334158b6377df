"""How a run begins: task and policy from its configuration, its first state, and what its workers are told."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from farm import plugins, rollouts, seeds, settings
from farm.arrays import FloatArray
from farm.errors import CheckpointError, ConfigError
from farm.net.messages import Spec
from farm.policies.base import Policy
from farm.rollouts import Runner, build_task
from farm.sim.scene import Scene
from farm.tasks.base import Task, TaskSpec
from learner import checkpoint as checkpoints
from learner import config as configs
from learner.algorithms import SearchState
from learner.checkpoint import Checkpoint
from learner.config import RunConfig
from learner.run_folder import RunFolder


@dataclass(frozen=True)
class Problem:
    """What a run searches for: parameters of a policy for a task."""

    config: RunConfig
    task: Task
    spec: TaskSpec
    policy: Policy
    code: Mapping[str, str]
    """Digests of the code that decides its numbers."""

    @cached_property
    def scene(self) -> Scene:
        """What there is to draw."""
        return Scene(self.task.model)

    def specification(self, run: str) -> Spec:
        """What workers are told."""
        config = self.config
        task, policy = plugins.find("tasks", config.task), plugins.find("policies", config.policy)
        return Spec(
            run=run, task=task.wire, task_config=settings.to_dict(config.task_config), release=task.release,
            policy=policy.wire, policy_config=settings.to_dict(config.policy_config), policy_release=policy.release,
            task_release=self.spec.release, code=dict(self.code), files=dict(self.task.sources),
            constants=dict(self.policy.constants),
        )  # fmt: skip

    def runner(self) -> Runner:
        """Simulate in this process.

        Raises:
          ConfigError: the task cannot be begun.
        """
        return Runner(self.task, self.policy)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that its classes come from, which workers must be allowed to serve."""
        found = (plugins.find("tasks", self.config.task), plugins.find("policies", self.config.policy))
        return tuple(dict.fromkeys(plugin.file for plugin in found if plugin.file is not None))


def problem(
    config: RunConfig, constants: Mapping[str, FloatArray] | None = None, files: Mapping[str, str] | None = None
) -> Problem:
    """What a configuration says, with the constants and texts that a run carries; without: drawn and read now.

    Raises:
      ConfigError: the task is not to be had here.
    """
    task = build_task(plugins.find("tasks", config.task), settings.to_dict(config.task_config), files)
    spec = task.spec()
    if config.stop_when_solved is not None and not spec.success:
        raise ConfigError(f"--stop-when-solved: {config.task} knows returns, but no success")
    kind = plugins.find("policies", config.policy).target
    if constants is None:
        constants = kind.draw(config.policy_config, spec, seeds.features(config.seed))
    return Problem(config, task, spec, cast("Policy", kind(config.policy_config, spec, constants)), _code(config))


def _code(config: RunConfig) -> dict[str, str]:
    """Digests of what decides a run's numbers."""
    found = {"task": plugins.find("tasks", config.task), "policy": plugins.find("policies", config.policy)}
    return {name: plugin.digest() for name, plugin in found.items()} | {
        "simulation": plugins.code_digest(rollouts.SIMULATION)
    }


def start(config: RunConfig, run: str) -> tuple[Problem, Checkpoint]:
    """A run before its first generation.

    Raises:
      ConfigError: the task is not to be had here, or the run to start from cannot be used.
    """
    other = None if config.init_from is None else _other(config)
    begun = problem(config, other.constants if other else None)
    state = config.algorithm_config.init(begun.policy.size)
    if other is not None:
        state = _taken_over(config, state, other)
    checkpoint = Checkpoint(
        run=run, config=configs.to_dict(config), state=state.to_dict(), rollouts=0, reissued=0, seconds=0.0,
        solved=0, best=None, best_generation=0, canary=None, replayed=True, code=dict(begun.code),
        files=dict(begun.task.sources), constants=dict(begun.policy.constants),
    )  # fmt: skip
    return begun, checkpoint


def resumed(config: RunConfig, at: Checkpoint, where: Path, *, mixed: bool = False) -> Problem:
    """A run as its checkpoint left it.

    Raises:
      CheckpointError: the code that decides its numbers is another now, and `mixed` does not allow it.
    """
    found = problem(config, at.constants, at.files)
    changed = [name for name, digest in found.code.items() if at.code.get(name) != digest]
    if changed and not mixed:
        raise CheckpointError(
            f"{where}: the code of its {' and '.join(changed)} has changed since the run began: put it back, begin a "
            "new run with --init-from, or go on with --mixed and do without repeatable numbers"
        )
    return found


def _other(config: RunConfig) -> Checkpoint:
    """The run to start from, if its parameters mean the same."""
    folder = RunFolder.open(Path(str(config.init_from)))
    theirs = folder.read_config()
    same: tuple[tuple[Any, Any], ...] = (
        (theirs.task, config.task),
        (theirs.policy, config.policy),
        (theirs.policy_config, config.policy_config),
    )
    for there, here in same:
        if there != here:
            raise ConfigError(
                f"--init-from {config.init_from}: its parameters mean something else ({there}, not {here})"
            )
    return checkpoints.load(folder.checkpoint)


def _taken_over(config: RunConfig, fresh: SearchState, at: Checkpoint) -> SearchState:
    """Start from another run's mean, and perhaps its sigma."""
    if len(at.state["mu"]) != len(fresh.mu):
        raise ConfigError(
            f"--init-from {config.init_from}: it has {len(at.state['mu'])} parameters, this run {len(fresh.mu)}: "
            "its observation is another"
        )
    state = replace(fresh, mu=at.state["mu"])
    return replace(state, sigma=at.state["sigma"]) if config.init_sigma == "run" else state
