"""Why rollouts become unstable: how they start, which joint leaves first, and which remedies help
when tried.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from farm.arrays import FloatArray
from farm.runner import Runner
from farm.sim.engines import BatchEngine
from farm.sim.instability import (
    Remedy,
    WatchedEngine,
    first_joint,
    outside,
    overlapping,
    remedies,
    too_stiff,
)
from farm.sim.interfaces import MakeEngine
from farm.tasks.base import Task
from farm.tasks.rollouts import Rollouts, Seed
from learner.run import setup
from learner.run.config import RunConfig

if TYPE_CHECKING:
    from farm.policies.base import Policy

_WEAKER: Final = 0.1


def causes(
    config: RunConfig, theta: FloatArray, starts: Sequence[Seed], rollouts: Rollouts
) -> Iterator[str]:
    """Lines about unstable rollouts of parameters (B, P): what is seen, and what helps when it is
    tried.

    Args:
      config: of a run of the task.
      theta: the parameters.
      starts: seeds of their starts.
      rollouts: their results, at least one of which failed.
    """
    task = setup.problem(config).task
    own_engine = type(task).engine is not Task.engine or len(task.simulated) > 1
    failures = np.flatnonzero(rollouts.failed)
    yield f"the first in control step {int(rollouts.steps[failures].min())} of {task.steps}"
    yield from outside(task.model, rollouts.start["qpos"])
    mocap = rollouts.start.get("mocap")
    yield from overlapping(
        task.model,
        rollouts.start["qpos"][failures[0]],
        None if mocap is None else mocap[failures[0]],
    )
    if own_engine:
        return
    watched: list[WatchedEngine] = []

    def engine(model: Any) -> WatchedEngine:  # noqa: ANN401  MuJoCo's
        watched.append(WatchedEngine(model))
        return watched[-1]

    _tried(config, theta, starts, engine=engine)
    first = next((each.first for each in watched if each.first is not None), None)
    if first is not None and (joint := first_joint(task.model, first)):
        yield f"{joint} left first"
    yield from too_stiff(task.model)
    unlimited = int(np.count_nonzero(task.model.actuator_ctrllimited == 0))
    if unlimited:
        yield (
            f"{unlimited} of {task.model.nu} actuators have no ctrlrange, so that commands have no"
            " limit"
        )
    for remedy in remedies(task.model):
        yield _words(remedy.words, _tried(config, theta, starts, remedy), len(theta))
    weaker = f"actions times {_WEAKER:g}, so that commands do not use their full range"
    yield _words(weaker, _tried(config, theta, starts, share=_WEAKER), len(theta))


def _words(remedy: str, failed: int, count: int) -> str:
    return f"tried {remedy}: {f'{failed} of {count} unstable' if failed else 'none is unstable'}"


def _tried(
    config: RunConfig,
    theta: FloatArray,
    starts: Sequence[Seed],
    remedy: Remedy | None = None,
    *,
    share: float = 1.0,
    engine: MakeEngine = BatchEngine,
) -> int:
    """How many of the rollouts fail with a changed model, a share of the actions, or another
    engine.
    """
    problem = setup.problem(config)
    if remedy is not None:
        remedy.change(problem.task.model)
        problem.task.substeps *= remedy.finer
    runner = Runner(problem.task, problem.policy, engine)
    if share != 1.0:
        runner.policy = _Weaker(problem.policy, share)  # type: ignore[assignment]  # it acts
    try:
        return int(runner.rollouts(theta, starts).failed.sum())
    finally:
        runner.close()


class _Weaker:
    """A policy whose actions are multiplied."""

    def __init__(self, policy: "Policy", share: float) -> None:
        self._policy: Any = policy
        self._share = share
        self.memory: FloatArray | None = policy.memory
        self.scale: FloatArray | None = policy.scale

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Prepare parameters as the wrapped policy does."""
        prepared: FloatArray = self._policy.prepare(theta)
        return prepared

    def act(self, *arrays: FloatArray) -> Any:  # noqa: ANN401  an array, with memory a pair
        """Return a share of the wrapped policy's actions."""
        action = self._policy.act(*arrays)
        return (
            (self._share * action[0], action[1])
            if isinstance(action, tuple)
            else self._share * action
        )
