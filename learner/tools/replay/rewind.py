"""Repeats a generation's exploring rollouts from their seeds.

The rollouts themselves are not stored.

import farm

again = farm.rewind("runs/first", 12)
print(again.returns, again.rollout(again.worst(1)[0]).trajectory.success)
"""

import itertools
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from farm import seeds as streams
from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.moments import merged, normaliser_of
from farm.net.work import Jobs, Simulated
from farm.tasks.rollouts import Rollouts, Seed
from learner import algorithms
from learner.algorithms import SearchState
from learner.pool.round import RoundResults
from learner.run import checkpoint as checkpoints
from learner.run.checkpoint import Checkpoint
from learner.run.evaluation import statistics, validation, whole_round
from learner.run.files import NONE
from learner.run.folder import RunFolder, opened
from learner.run.learner import explored, learnt_from
from learner.run.parts import Parts
from learner.run.setup import Problem, start
from learner.run.shrinking import Shrinking
from learner.tools.replay.loaded import LoadedPolicy, Replay, restored, seeing
from learner.tools.replay.ranked import Ranked

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rewound(Ranked):
    """The exploring rollouts of a generation, simulated again at control rate; S of them, in the
    run's order.
    """

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
        """Return of each, (S,): bit for bit those that the run learnt from, before the reward's
        offset.
        """
        return self.rollouts.returns

    @property
    def early(self) -> BoolArray:
        """Which rollouts the task ended before their last step, (S,)."""
        return self.rollouts.ended

    def again(self, indices: Sequence[int], policy: LoadedPolicy | None = None) -> list[Replay]:
        """Simulate some of the rollouts at physics rate, with the task's settings of `policy` if it
        is given.

        Raises:
          ConfigError: there is no such rollout.
        """
        for index in indices:
            if not 0 <= index < len(self.theta):
                last = len(self.theta) - 1
                raise ConfigError(
                    f"generation {self.generation} has no rollout {index}: there are 0 to {last}"
                )
        rows = list(indices)
        return (policy or self.policy).rollouts(self.theta[rows], [self.seeds[i] for i in rows])

    def rollout(self, index: int) -> Replay:
        """Simulate one of the rollouts at physics rate; a ConfigError if there is none."""
        return self.again([index])[0]


def rewind(
    path: str | Path, generation: int | None = None, *, allow_file: str | Path | None = None
) -> Rewound:
    """The exploring rollouts of a generation (None: the last) of the run in a folder; `allow_file`
    as in `farm.load`.

    If `ask` depends on mu and sigma only, the state before the generation is read from
    `parameters`. For other algorithms, and if that generation is not stored, the run is learnt
    again up to there.

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
    return rewound(opened(path, allow_file), generation)


def rewound(folder: RunFolder, generation: int | None = None) -> Rewound:
    """Rewind a run in an opened folder, like `rewind`."""
    config, at = folder.read_config(), checkpoints.load(folder.checkpoint)
    last = int(at.state["generation"])
    number = last if generation is None else generation
    if not isinstance(number, int | np.integer):
        raise ConfigError(f"generation is {number!r:.40}; expected a whole number from 1")
    if not 1 <= number <= last:
        behind = f"it has done generations 1 to {last}" if last else "it has done no generation"
        raise ConfigError(
            f"generation {number} of the run in {folder.path} has no rollouts: {behind}"
        )
    problem = restored(folder, at)
    state, normaliser = before(folder, at, problem, number)
    policy = LoadedPolicy(seeing(problem, normaliser), number - 1, state.mu)
    jobs = explored(config, state, pairs_of(folder, number))[1]
    theta, seeds = jobs.theta(state.mu), jobs.seeds()
    again = Rewound(policy, normaliser, number, theta, seeds, policy.runner.rollouts(theta, seeds))
    _compare(folder, again)
    return again


def under(folder: RunFolder, rewound: Rewound, task: Any) -> LoadedPolicy:  # noqa: ANN401
    """The policy of a repeated generation with other settings of its task; a ConfigError if that
    is impossible.
    """
    problem = restored(folder, checkpoints.load(folder.checkpoint), task)
    return LoadedPolicy(seeing(problem, rewound.seen), rewound.policy.generation, rewound.policy.mu)


def before(
    folder: RunFolder, at: Checkpoint, problem: Problem, generation: int
) -> tuple[SearchState, FloatArray]:
    """The algorithm's state before a generation was drawn, and the normaliser of its
    observations.
    """
    if generation in kept(folder, at, problem):
        rows = folder.parameters.rows() if generation > 1 else []
        return from_row(
            problem, at, next((row for row in rows if row["generation"] == generation - 1), None)
        )
    again = LearntAgain(folder, problem)
    if generation > 1:
        message = (
            "the state of %s before generation %d is not stored: learning the run again up to there"
        )
        log.warning(message, folder.read_config().algorithm, generation)
    with closing(problem.runner()) as runner:
        while again.state.generation < generation - 1:
            again.step(lambda mu, jobs, normaliser: runner.run(mu, jobs, "none", normaliser))
    return again.state, again.normaliser


def from_row(problem: Problem, at: Checkpoint, row: Any) -> tuple[SearchState, FloatArray]:  # noqa: ANN401
    """State and normaliser after the generation of a row of `parameters`; None: the beginning."""
    fresh = problem.begin()
    if row is None:
        return fresh, normaliser_of(np.zeros_like(at.moments))
    state = replace(fresh, mu=row["mu"], sigma=row["sigma"], generation=int(row["generation"]))
    return state, row["normaliser"] if "normaliser" in row.dtype.names else NONE


def kept(folder: RunFolder, at: Checkpoint, problem: Problem) -> list[int]:
    """Generations whose state before them is stored, in order."""
    config, last = folder.read_config(), int(at.state["generation"])
    generations = [1] if last and config.init_from is None else []
    algorithm: Any = config.algorithm_config
    if last and _draws_alike(algorithm, problem.begin(), algorithm.restore(at.state)):
        rows = (
            folder.parameters.rows()["generation"]
            if folder.parameters.path.exists()
            else np.empty(0, int)
        )
        generations += (rows[rows < last] + 1).tolist()
    return generations


def pairs_of(folder: RunFolder, generation: int) -> int:
    """Pairs of a generation with --interactions; 0: the number in the algorithm's settings."""
    config = folder.read_config()
    if config.interactions is None:
        return 0
    lines = itertools.takewhile(
        lambda line: line.generation <= generation, folder.progress_after(generation - 2)
    )
    rollouts = {line.generation: line.rollouts for line in lines} | {0: 0}
    pairs, least = 0, config.algorithm_config.pairs  # type: ignore[attr-defined]
    if {generation - 1, generation} <= rollouts.keys():
        each = config.episodes * len(config.algorithm_config.signs())
        rows = (rollouts[generation] - rollouts[generation - 1]) // each
        pairs = rows * least // len(explored(config, config.algorithm_config.init(1))[0])
    if not least <= pairs <= config.pairs_at_most:
        raise ConfigError(
            f"{folder.path}: progress.jsonl does not say how many pairs generation {generation} had"
        )
    return pairs


def _draws_alike(algorithm: Any, fresh: SearchState, last: SearchState) -> bool:  # noqa: ANN401
    """Whether `ask` depends on mu and sigma only, not on other state such as a covariance."""
    bare = replace(fresh, mu=last.mu, sigma=last.sigma, generation=last.generation)
    with_all, without = (algorithm.ask(state, streams.exploration(0, 0)) for state in (last, bare))
    return with_all.tobytes() == without.tobytes()


Simulate: TypeAlias = Callable[[FloatArray, Jobs, FloatArray], Simulated | RoundResults]
"""Results of jobs around a mean (P,), with a RoundHeader's normaliser."""


class LearntAgain:
    """A run that is learnt again from its start by generations: slow, but for any algorithm, with
    the same bits.
    """

    def __init__(self, folder: RunFolder, problem: Problem) -> None:
        """Begin before its first generation."""
        self._problem, self._config = problem, folder.read_config()
        first = start(self._config, folder.name, problem.task.sources)[1]
        algorithm: Any = self._config.algorithm_config
        self.state: SearchState = algorithm.restore(first.state)
        """The algorithm's state so far."""
        self._moments, self._pairs = first.moments, 0
        self._shrinking = Shrinking()
        self._best = -math.inf

    @property
    def normaliser(self) -> FloatArray:
        """The normaliser of the next generation's observations, (2, d) or (2, 0)."""
        return normaliser_of(self._moments)

    def step(self, simulate: Simulate) -> tuple[Parts, Simulated | RoundResults]:
        """Learn one generation; return its `whole_round` and the results."""
        config, state = self._config, self.state
        eps, exploring = explored(config, state, self._pairs)
        parts = whole_round(config, int(state.generation), exploring)
        results = simulate(state.mu, parts.jobs, np.stack([self.normaliser] * 2))
        rows = parts.rows("explore")
        returns, steps = results.returns[rows], results.steps[rows]
        learnt = learnt_from(config, self._problem.task, returns, steps)
        algorithm = config.algorithm_of(self._pairs, self._shrinking.share)
        self.state = algorithms.tell(algorithm, state, eps, learnt)
        if (score := validation(parts, results.returns)) is not None:
            self._shrinking = self._shrinking.after(
                better=score > self._best, patience=config.shrink_after
            )
            self._best = max(self._best, score)
        self._moments = merged(self._moments, results.moments[rows])
        self._pairs = config.pairs_after(self._pairs, int(steps.sum()))
        return parts, results


def _compare(folder: RunFolder, rewound: Rewound) -> None:
    """Warn if the returns differ from the run's mean, extremes and spread in progress.jsonl."""
    values = rewound.returns
    for line in folder.progress():
        if line.generation == rewound.generation:
            here = statistics(values)
            if here != {name: getattr(line, name) for name in here}:
                log.warning(
                    "%s: these are not the rollouts of generation %d to the last bit: their mean"
                    " return was %s and is %s here; code or --init-from run have changed, or this"
                    " processor rounds differently",
                    folder.path,
                    rewound.generation,
                    line.return_mean,
                    here["return_mean"],
                )
