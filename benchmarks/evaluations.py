"""The evaluations that peers.py times, in a separate module, so that the workers of each backend
can import it.
"""

import functools
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mujoco.batch
import numpy as np

from farm.arrays import FloatArray
from farm.runner import Runner
from farm.tasks.finger_gait.holding import CLOSING, SUBSTEPS
from farm.tasks.loop import Batch, again
from learner.run.config import RunConfig, configure
from learner.run.setup import problem

HERE = Path(__file__).parent
STILL = 50.0
"""Value of every parameter of the gait's policy: so far from every joint position that no rollout
ends early.
"""

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "eq_active", "mocap_pos", "mocap_quat")

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "gait": ("finger-gait", {}),
    # No other tool has a normaliser
    "arm": (f"{HERE.parent / 'examples/tasks/arm.py'}:Arm", {"normalise": False}),
    "zero": (f"{HERE / 'zero_cost.py'}:ZeroCost", {"policy": "linear"}),
}
"""Task and settings of a kind of evaluation; `zero` takes no time."""


def config(kind: str, **more: Any) -> RunConfig:  # noqa: ANN401
    """Configuration of a kind of evaluation."""
    task, settings = TASKS[kind]
    return configure(task, **settings, **more)


@functools.cache
def runner(kind: str) -> Runner:
    """What evaluates it, built once in each process."""
    return problem(config(kind)).runner()


def theta(kind: str, rows: int) -> FloatArray:
    """Parameters to evaluate, (rows, P)."""
    noise = 0.02 * np.random.default_rng(0).standard_normal((rows, runner(kind).size))
    return noise + STILL if kind == "gait" else noise


def evaluate(kind: str, parameters: FloatArray) -> FloatArray:
    """Returns of rollouts with parameters (B, P); both rollouts of a pair have the same
    perturbed start.
    """
    if kind == "zero":
        return np.asarray(parameters.sum(axis=1))
    return (
        runner(kind).rollouts(parameters, [(row // 2,) for row in range(len(parameters))]).returns
    )


def serve(end: Connection) -> None:
    """Evaluate what comes through a pipe, until it closes."""
    while True:
        try:
            kind, parameters = end.recv()
        except EOFError:
            return
        end.send(evaluate(kind, parameters))


def steps(kind: str) -> float:
    """Physics steps of a rollout.

    The gait's include its half of those that close the grip of a pair.
    """
    task = runner(kind).task
    return task.steps * SUBSTEPS + CLOSING / 2 if kind == "gait" else task.steps * task.substeps


@functools.cache
def _bare(
    kind: str, count: int, threads: int
) -> tuple[mujoco.batch.Batch, list[tuple[FloatArray, FloatArray]]]:
    """A batch of simulations, and its states, each with the values that it has when a rollout
    begins.
    """
    sim, task = runner(kind).sim, runner(kind).task
    rows = np.arange(count) % 64
    again(lambda: Batch(task, sim, [(int(row) // 2,) for row in range(64)]))
    bare = mujoco.batch.Batch(sim.model, count, threads)
    return bare, [(bare.bind(name), np.array(getattr(sim, name)[rows])) for name in STATE]


def physics(kind: str, count: int, threads: int) -> None:
    """The physics steps of so many rollouts, and nothing else; each begins as a rollout does."""
    bare, states = _bare(kind, count, threads)
    for state, start in states:
        state[:] = start
    bare.step(nstep=int(steps(kind)))


def pid(_: int = 0) -> int:
    """The process in which a worker runs."""
    time.sleep(0.1)
    return os.getpid()
