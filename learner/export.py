"""Exports a learnt policy as one .npz for plain MuJoCo and numpy; docs/export.md describes it."""

import json
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from farm import settings
from farm.errors import writing
from farm.sim.engines import STATE, DataEngine
from farm.sim.sim import Sim
from farm.tasks.loop import Batch
from learner.replay import LoadedPolicy

VERSION: Final = 2
"""Version of the file."""


def contents(policy: LoadedPolicy) -> dict[str, Any]:
    """The contents of the file by name."""
    found = policy.problem
    task, config = found.task, found.config
    engine = DataEngine(task.model)
    sim = Sim(engine)
    task.setup(sim)
    batch = Batch(task, sim, [None])
    state = np.empty(mujoco.mj_stateSize(task.model, STATE))
    mujoco.mj_getState(task.model, engine.data, state, STATE)
    return {
        "version": VERSION,
        "task": config.task.rpartition("/")[2],
        "policy": config.policy.rpartition("/")[2],
        "task_config": json.dumps(settings.to_dict(config.task_config)),
        "policy_config": json.dumps(settings.to_dict(config.policy_config)),
        "generation": policy.generation,
        "mjcf": task.mjcf(),
        "mu": policy.mu,
        "state": state,
        "state_kind": STATE,
        "x": batch.observe()[0],
        "steps": task.steps,
        "substeps": task.substeps,
        "control_period": task.period,
        "gamma": task.config.gamma,
        "return_scale": task.return_scale,
        **found.policy.constants,
        **task.exported(),
    }


def write(path: Path, policy: LoadedPolicy) -> None:
    """Write the file; it holds arrays and texts, and needs no unpickling.

    Raises:
      RunError: it cannot be written.
    """
    with writing(path), path.open("wb") as file:  # np.savez would append a suffix
        np.savez_compressed(file, allow_pickle=False, **contents(policy))
