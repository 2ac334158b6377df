"""Baselines that a run's policy is compared with: doing nothing and a constant action, from the
starts of the evaluation.

Doing nothing is the action zero, the middle of the actuators' ranges. The constant action is the
best of CONSTANTS, drawn uniformly from [-1, 1] and alike for all runs of a task: each is tried from
TRIES starts of validation. All is simulated by this process, so that it depends on no worker.
"""

import logging
from collections.abc import Callable
from contextlib import closing
from typing import Any, Final

import numpy as np

from farm import seeds
from farm.arrays import FloatArray
from farm.errors import brief
from farm.net.work import Jobs
from farm.policies.base import PolicyConfig
from farm.policies.networks import Constant
from farm.runner import Runner
from learner.run.evaluation import (
    EVALUATION_ROLLOUTS,
    EVALUATION_SEED,
    means_of_measures,
    score,
    success_rate,
)
from learner.run.setup import Problem

log = logging.getLogger(__name__)

CONSTANTS: Final = 32
"""Constant actions that are tried."""

TRIES: Final = 4
"""Starts from which each is tried."""


def without_learning(problem: Problem, stopped: Callable[[], bool]) -> dict[str, Any] | None:
    """Figures of doing nothing and of the best constant action, as in summary.json; None if the
    user stopped it.
    """
    log.info("simulating doing nothing and constant actions, for comparison (Ctrl-C leaves it out)")
    try:
        with closing(Runner(problem.task, Constant(PolicyConfig(), problem.spec, {}))) as runner:
            return _simulated(runner, problem.config.seed, stopped)
    except Exception as error:  # a task may need what only the workers' machines have, or be strict
        log.warning(
            "this machine cannot simulate doing nothing (%s: %s)",
            type(error).__name__,
            brief(str(error)),
        )
        return None


def _simulated(runner: Runner, seed: int, stopped: Callable[[], bool]) -> dict[str, Any] | None:
    nothing = _figures(runner, np.zeros(runner.spec.action))
    starts = [seeds.validation(seed, start) for start in range(TRIES)]
    actions = seeds.constant().uniform(-1.0, 1.0, (CONSTANTS, runner.spec.action))
    scores = []
    for action in actions:
        if stopped():
            return None
        value = score(runner.run(action, Jobs.mean("none", starts)).returns)
        scores.append(-np.inf if value is None else value)
    best = actions[int(np.argmax(scores))]
    return {"nothing": nothing, "constant": {**_figures(runner, best), "action": best.tolist()}}


def _figures(runner: Runner, action: FloatArray) -> dict[str, Any]:
    """Score, success and measures of a constant action (A,) from the starts of the evaluation."""
    starts = [
        seeds.evaluation_start(EVALUATION_SEED, start) for start in range(EVALUATION_ROLLOUTS)
    ]
    results = runner.run(action, Jobs.mean("none", starts))
    figures: dict[str, Any] = {"score": score(results.returns)}
    if runner.spec.success:
        figures["success_rate"] = success_rate(runner.spec, results.flags)
    if runner.spec.measures:
        figures["measures"] = means_of_measures(runner.spec, results, slice(EVALUATION_ROLLOUTS))
    return figures
