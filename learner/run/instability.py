"""Why rollouts become unstable: how they start, which joint leaves first, and which remedies help when tried."""

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.runner import Runner
from farm.sim.engines import BatchEngine
from farm.sim.instability import WatchedEngine, bare_dofs, first_joint, outside, overlapping, too_stiff
from farm.tasks.base import Task
from farm.tasks.rollouts import Rollouts, Seed
from learner.run import setup
from learner.run.config import RunConfig

if TYPE_CHECKING:
    from farm.policies.base import Policy

_ARMATURE: Final = 0.01  # [kg m^2] or [kg]
_DAMPING: Final = 0.1  # [N m s / rad] or [N s / m]
_WEAKER: Final = 0.1
_FINER: Final = 5


def causes(config: RunConfig, theta: FloatArray, starts: Sequence[Seed], rollouts: Rollouts) -> Iterator[str]:
    """Lines about unstable rollouts of parameters (B, P): what is seen, and what helps when it is tried.

    Args:
      config: of a run of the task.
      theta: the parameters.
      starts: seeds of their starts.
      rollouts: their results, at least one of which failed.
    """
    task = setup.problem(config).task
    own_engine = type(task).engine is not Task.engine or len(task.simulated) > 1
    gone = np.flatnonzero(rollouts.failed)
    yield f"the first in control step {int(rollouts.steps[gone].min())} of {task.steps}"
    yield from outside(task.model, rollouts.start["qpos"])
    mocap = rollouts.start.get("mocap")
    yield from overlapping(task.model, rollouts.start["qpos"][gone[0]], None if mocap is None else mocap[gone[0]])
    if own_engine:
        return
    watched: list[WatchedEngine] = []

    def engine(model: mujoco.MjModel) -> WatchedEngine:
        watched.append(WatchedEngine(model))
        return watched[-1]

    _tried(config, theta, starts, engine=engine)
    first = next((each.first for each in watched if each.first is not None), None)
    if first is not None and (joint := first_joint(task.model, first)):
        yield f"{joint} left first"
    yield from too_stiff(task.model)
    unlimited = int(np.count_nonzero(task.model.actuator_ctrllimited == 0))
    if unlimited:
        yield f"{unlimited} of {task.model.nu} actuators have no ctrlrange, so that commands have no limit"
    yield from _remedies(config, theta, starts, task.model)


def _remedies(config: RunConfig, theta: FloatArray, starts: Sequence[Seed], model: mujoco.MjModel) -> Iterator[str]:
    """How many rollouts stay unstable with each remedy that fits the model."""
    count, step = len(theta), model.opt.timestep / _FINER
    remedies: list[tuple[str, Callable[[Task], None], float]] = [
        (f"a timestep of {step:g} s", _finer, 1.0),
        (f"actions times {_WEAKER:g}, so that commands do not use their full range", _nothing, _WEAKER),
    ]
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        remedies.insert(1, ('<option integrator="implicitfast"/>', _implicit, 1.0))
    if bare := len(bare_dofs(model)):
        text = f'armature="{_ARMATURE:g}" and damping="{_DAMPING:g}" for the {bare} joints that have neither'
        remedies.insert(1, (text, _heavier, 1.0))
    for words, change, share in remedies:
        failed = _tried(config, theta, starts, change=change, share=share)
        yield f"tried {words}: {f'{failed} of {count} unstable' if failed else 'none is unstable'}"


def _tried(
    config: RunConfig,
    theta: FloatArray,
    starts: Sequence[Seed],
    *,
    change: Callable[[Task], None] | None = None,
    share: float = 1.0,
    engine: Callable[[mujoco.MjModel], BatchEngine] = BatchEngine,
) -> int:
    """How many of the rollouts fail with a changed task, a share of the actions, or another engine."""
    problem = setup.problem(config)
    if change is not None:
        change(problem.task)
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
        """As the policy does."""
        prepared: FloatArray = self._policy.prepare(theta)
        return prepared

    def act(self, *given: FloatArray) -> Any:  # noqa: ANN401  an array, with memory a pair
        """A share of its actions."""
        action = self._policy.act(*given)
        return (self._share * action[0], action[1]) if isinstance(action, tuple) else self._share * action


def _nothing(task: Task) -> None:
    """Leave the task as it is."""


def _finer(task: Task) -> None:
    task.model.opt.timestep /= _FINER
    task.substeps *= _FINER


def _implicit(task: Task) -> None:
    task.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _heavier(task: Task) -> None:
    dofs = bare_dofs(task.model)
    task.model.dof_armature[dofs] = _ARMATURE
    task.model.dof_damping[dofs] = _DAMPING
