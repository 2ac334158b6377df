"""Baselines that a run's policy is compared with: doing nothing and a constant action, from the
starts of the evaluation.

Doing nothing is the action zero, the middle of the actuators' ranges. The constant action is the
best of CONSTANTS, drawn uniformly from [-1, 1] and alike for all runs of a task: each is tried from
TRIES starts of validation. All is simulated by processes of this machine: the run's workers have
its own policy.
"""

import logging
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from typing import Any, Final

import numpy as np

from farm import plugins, seeds
from farm.errors import Interrupted, brief
from farm.net.work import Jobs, Simulated
from farm.policies.base import PolicyConfig
from farm.runner import build_policy
from farm.tasks.base import TaskSpec
from learner.run.evaluation import (
    EVALUATION_ROLLOUTS,
    EVALUATION_SEED,
    means_of_measures,
    score,
    success_rate,
)
from learner.run.parallel import ParallelRunner
from learner.run.parts import Parts
from learner.run.setup import Problem

log = logging.getLogger(__name__)

CONSTANTS: Final = 32
"""Constant actions that are tried."""

TRIES: Final = 4
"""Starts from which each is tried."""


def without_learning(
    problem: Problem, stopped: Callable[[], bool], processes: int = 1
) -> dict[str, Any] | None:
    """Figures of doing nothing and of the best constant action, as in summary.json; None if the
    user stopped it.

    Args:
      problem: of the run.
      stopped: whether the user has asked to stop.
      processes: that simulate, at most; the figures are the same for any number.
    """
    log.info("simulating doing nothing and constant actions, for comparison (Ctrl-C leaves it out)")
    plugin = plugins.find("policies", "constant")
    config = replace(problem.config, policy="constant", policy_config=PolicyConfig())
    policy = build_policy(plugin, config.policy_config, problem.spec, {})
    constant = replace(problem, config=config, policy=policy)
    try:
        with closing(ParallelRunner(constant, processes, stopped)) as runner:
            return _simulated(runner, config.seed)
    except Interrupted:
        return None
    except Exception as error:  # a task may need what only the workers' machines have, or be strict
        log.warning(
            "this machine cannot simulate doing nothing (%s: %s)",
            type(error).__name__,
            brief(str(error)),
        )
        return None


def _simulated(runner: ParallelRunner, seed: int) -> dict[str, Any]:
    starts = [
        seeds.evaluation_start(EVALUATION_SEED, start) for start in range(EVALUATION_ROLLOUTS)
    ]
    tries = [seeds.validation(seed, start) for start in range(TRIES)]
    actions = seeds.constant().uniform(-1.0, 1.0, (CONSTANTS, runner.spec.action))
    parts = Parts(
        nothing=Jobs.mean("none", starts),
        constants=Jobs.exploring(np.repeat(actions, TRIES, axis=0), (1,), tries * CONSTANTS),
    )
    zero = np.zeros(runner.spec.action)
    results = runner.run(zero, parts.jobs)
    nothing = _figures(runner.spec, results, parts.rows("nothing"))
    returns = results.returns[parts.rows("constants")].reshape(CONSTANTS, TRIES)
    scores = [score(each) for each in returns]
    best = actions[int(np.argmax([-np.inf if each is None else each for each in scores]))]
    results = runner.run(best, Jobs.mean("none", starts))
    constant = _figures(runner.spec, results, slice(EVALUATION_ROLLOUTS))
    return {"nothing": nothing, "constant": {**constant, "action": best.tolist()}}


def _figures(spec: TaskSpec, results: Simulated, rows: slice) -> dict[str, Any]:
    """Score, success and measures of rollouts."""
    figures: dict[str, Any] = {"score": score(results.returns[rows])}
    if spec.success:
        figures["success_rate"] = success_rate(spec, results.flags[rows])
    if spec.measures:
        figures["measures"] = means_of_measures(spec, results, rows)
    return figures
