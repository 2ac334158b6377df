"""Repeats a generation's exploring rollouts from their seeds; the rollouts themselves are not stored.

import farm

again = farm.rewind("runs/first", 12)
print(again.returns, again.rollout(again.worst(1)[0]).trajectory.success)
"""

import logging
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.moments import merged, normaliser_of
from farm.tasks.rollouts import Rollouts, Seed
from learner import algorithms
from learner.again.replay import LoadedPolicy, Replay, restored, seeing
from learner.algorithms import SearchState
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import Checkpoint
from learner.run.evaluation import statistics
from learner.run.folder import RunFolder
from learner.run.learner import explored, learnt_from
from learner.run.setup import Problem, start

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rewound:
    """The exploring rollouts of a generation, simulated again at control rate; S of them, in the run's order."""

    policy: LoadedPolicy
    """The mean that the generation explored around, with the run's own settings."""
    seen: FloatArray
    """Mean and standard deviation that its observations were normalised by, (2, d) or (2, 0)"""
    generation: int
    """Counted from 1, as in progress.jsonl: its rollouts led to update number `generation`."""
    theta: FloatArray
    """Parameters of each, (S, P)"""
    seeds: Sequence[Seed]
    """Seed of each one's start and conditions; None: nominal"""
    rollouts: Rollouts
    """The results"""

    @property
    def returns(self) -> FloatArray:
        """Return of each, (S,): bit for bit those that the run learnt from, before the reward's offset."""
        return self.rollouts.returns

    def best(self, count: int) -> list[int]:
        """Indices of the rollouts with the highest returns, in descending order; of equal ones the first."""
        return np.argsort(-self.returns, kind="stable")[:count].tolist()

    def worst(self, count: int) -> list[int]:
        """Indices of the rollouts with the lowest returns, in ascending order; of equal ones the first."""
        return np.argsort(self.returns, kind="stable")[:count].tolist()

    def ended(self, count: int) -> list[int]:
        """Indices of the first rollouts that the task ended before their last step, for example after a drop."""
        return np.flatnonzero(self.rollouts.ended)[:count].tolist()

    def again(self, indices: Sequence[int], policy: LoadedPolicy | None = None) -> list[Replay]:
        """Simulate some of them at physics rate, with the task's settings of `policy` if it is given.

        Raises:
          ConfigError: there is no such rollout.
        """
        for index in indices:
            if not 0 <= index < len(self.theta):
                last = len(self.theta) - 1
                raise ConfigError(f"generation {self.generation} has no rollout {index}: there are 0 to {last}")
        rows = list(indices)
        return (policy or self.policy).rollouts(self.theta[rows], [self.seeds[i] for i in rows])

    def rollout(self, index: int) -> Replay:
        """One of them at physics rate; a ConfigError if there is none."""
        return self.again([index])[0]


def rewind(path: str | Path, generation: int | None = None) -> Rewound:
    """The exploring rollouts of a generation (None: the last) of the run in a folder.

    If `ask` depends on mu and sigma only, the state before the generation is read from `parameters`. For other
    algorithms, and if that generation is not stored, the run is learnt again up to there.

    Raises:
      ConfigError: the run has not done this generation.

    Example:
      ```python
      import farm

      again = farm.rewind("runs/first", 1)  # the first generation
      [worst] = again.worst(1)
      assert again.rollout(worst).trajectory.value == again.returns.min()
      ```
    """
    folder = RunFolder.open(Path(path))
    config, at = folder.read_config(), checkpoints.load(folder.checkpoint)
    last = int(at.state["generation"])
    number = last if generation is None else generation
    if not 1 <= number <= last:
        behind = f"it has done generations 1 to {last}" if last else "it has done no generation"
        raise ConfigError(f"generation {number} of the run in {folder.path} has no rollouts: {behind}")
    problem = restored(folder, at)
    state, normaliser = before(folder, at, problem, number)
    policy = LoadedPolicy(seeing(problem, normaliser), number - 1, state.mu)
    jobs = explored(config, state, pairs_of(folder, number))[1]
    theta, seeds = jobs.theta(state.mu), jobs.seeds()
    rewound = Rewound(policy, normaliser, number, theta, seeds, policy.runner.rollouts(theta, seeds))
    _compare(folder, rewound)
    return rewound


def under(folder: RunFolder, rewound: Rewound, task: Any) -> LoadedPolicy:  # noqa: ANN401
    """The policy of a repeated generation with other settings of its task; a ConfigError if that is impossible."""
    problem = restored(folder, checkpoints.load(folder.checkpoint), task)
    return LoadedPolicy(seeing(problem, rewound.seen), rewound.policy.generation, rewound.policy.mu)


def before(folder: RunFolder, at: Checkpoint, problem: Problem, generation: int) -> tuple[SearchState, FloatArray]:
    """The algorithm's state before a generation was drawn, and the normaliser of its observations."""
    config, done = folder.read_config(), generation - 1
    algorithm: Any = config.algorithm_config
    fresh = problem.begin()
    if done == 0 and config.init_from is None:
        return fresh, normaliser_of(np.zeros_like(at.moments))
    if done and _draws_alike(algorithm, fresh, algorithm.restore(at.state)):
        rows = folder.parameters.rows()
        if done in rows["generation"]:
            mu, normaliser = folder.parameters.mean(done)
            sigma = rows["sigma"][rows["generation"] == done][0]
            return replace(fresh, mu=mu, sigma=sigma, generation=done), normaliser
    return _learn_again(folder, problem, done)


def pairs_of(folder: RunFolder, generation: int) -> int:
    """Pairs of a generation with --interactions; 0: the number in the algorithm's settings."""
    config = folder.read_config()
    if config.interactions is None:
        return 0
    rollouts = {line.generation: line.rollouts for line in folder.progress()} | {0: 0}
    pairs, least = 0, config.algorithm_config.pairs  # type: ignore[attr-defined]
    if {generation - 1, generation} <= rollouts.keys():
        each = config.episodes * len(config.algorithm_config.signs())
        rows = (rollouts[generation] - rollouts[generation - 1]) // each
        pairs = rows * least // len(explored(config, config.algorithm_config.init(1))[0])
    if not least <= pairs <= config.pairs_at_most:
        raise ConfigError(f"{folder.path}: progress.jsonl does not say how many pairs generation {generation} had")
    return pairs


def _draws_alike(algorithm: Any, fresh: SearchState, last: SearchState) -> bool:  # noqa: ANN401
    """Whether `ask` depends on mu and sigma only, not on other state such as a covariance."""
    bare = replace(fresh, mu=last.mu, sigma=last.sigma, generation=last.generation)
    with_all, without = (algorithm.ask(state, streams.exploration(0, 0)) for state in (last, bare))
    return with_all.tobytes() == without.tobytes()


def _learn_again(folder: RunFolder, problem: Problem, until: int) -> tuple[SearchState, FloatArray]:
    """Learn the run again in this process up to this update: slow, but works for any algorithm, with the same bits."""
    config = folder.read_config()
    algorithm: Any = config.algorithm_config
    first = start(config, folder.name, problem.task.sources)[1]
    state, moments = algorithm.restore(first.state), first.moments
    pairs = 0
    if until:
        message = "the state of %s before generation %d is not stored: learning the run again up to there"
        log.warning(message, config.algorithm, until + 1)
    with closing(problem.runner()) as runner:
        while state.generation < until:
            eps, jobs = explored(config, state, pairs)
            results = runner.run(state.mu, jobs, "none", np.stack([normaliser_of(moments)] * 2))
            returns = learnt_from(config, problem.task, results.returns, results.steps)
            state = algorithms.tell(config.algorithm_of(pairs), state, eps, returns)
            moments = merged(moments, results.moments)
            pairs = config.pairs_after(pairs, int(results.steps.sum()))
    return state, normaliser_of(moments)


def _compare(folder: RunFolder, rewound: Rewound) -> None:
    """Warn if the returns differ from the run's mean, extremes and spread in progress.jsonl."""
    values = rewound.returns
    for line in folder.progress():
        if line.generation == rewound.generation:
            here = statistics(values)
            if here != {name: getattr(line, name) for name in here}:
                log.warning(
                    "%s: these are not the rollouts of generation %d to the last bit: their mean return was %s and "
                    "is %s here; code or --init-from run have changed, or this processor rounds differently",
                    folder.path, rewound.generation, line.return_mean, here["return_mean"],
                )  # fmt: skip
