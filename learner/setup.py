"""How a run begins: its first state, its random features, and what its workers are told."""

from dataclasses import replace
from pathlib import Path

from farm import seeds as randomness
from farm import tasks
from farm.errors import ConfigError
from farm.net.messages import Spec
from farm.policies.fourier import Features, Policy
from learner import checkpoint as checkpoints
from learner import config as configs
from learner.algorithms import SearchState
from learner.checkpoint import Checkpoint
from learner.config import RunConfig
from learner.run_folder import RunFolder


def start(config: RunConfig, run: str) -> Checkpoint:
    """A run before its first generation.

    Raises:
      ConfigError: the task is not to be had here, or the run to start from cannot be used.
    """
    sizes = tasks.sizes(config.task)
    features = Features.draw(config.policy, sizes.observation, randomness.features(config.seed))
    policy = Policy(config.policy, sizes.observation, features, (sizes.lower, sizes.upper))
    state = config.algorithm.init(policy.size)
    if config.init_from is not None:
        state, features = _taken_over(config, state)
    return Checkpoint(
        run=run, config=configs.to_dict(config), state=state.to_dict(), rollouts=0, reissued=0, seconds=0.0,
        solved=0, best=None, best_generation=0, canary=None, replayed=True,
        frequencies=features.frequencies, phases=features.phases,
    )  # fmt: skip


def specification(config: RunConfig, at: Checkpoint) -> Spec:
    """What a run simulates, for workers."""
    settings, sizes = configs.to_dict(config), tasks.sizes(config.task)
    return Spec(
        run=at.run, task=config.task.task, release=sizes.release, task_config=settings["task"],
        policy_config=settings["policy"],
        frequencies=at.frequencies, phases=at.phases,
    )  # fmt: skip


def _taken_over(config: RunConfig, fresh: SearchState) -> tuple[SearchState, Features]:
    """Start from another run: its mean, perhaps its sigma, and the features that its parameters belong to."""
    other = RunFolder.open(Path(str(config.init_from)))
    theirs = other.read_config()
    same = (
        (theirs.task.task, config.task.task),
        (theirs.policy, config.policy),
        (theirs.task.state, config.task.state),
    )
    for there, here in same:
        if there != here:
            raise ConfigError(
                f"--init-from {config.init_from}: its parameters mean something else ({there}, not {here})"
            )
    at = checkpoints.load(other.checkpoint)
    state = replace(fresh, mu=at.state["mu"])
    if config.init_sigma == "run":
        state = replace(state, sigma=at.state["sigma"])
    return state, Features(at.frequencies, at.phases)
