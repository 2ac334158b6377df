"""Exports a learnt policy as one .npz for plain MuJoCo and numpy; docs/export.md describes it."""

import io
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from farm import settings
from farm.errors import ConfigError, writing
from farm.sim.engines import STATE, DataEngine
from farm.sim.model_files import needed
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Batch
from learner.run import checkpoint
from learner.tools.export.interface import interface
from learner.tools.replay.loaded import LoadedPolicy

VERSION: Final = 3
"""Version of the file."""


def contents(policy: LoadedPolicy) -> dict[str, Any]:
    """The contents of the file by name."""
    problem = policy.problem
    task, config = problem.task, problem.config
    engine = DataEngine(task.model)
    sim = Sim(engine)
    task.setup(sim)
    batch = Batch(task, sim, [None])
    state = np.empty(mujoco.mj_stateSize(task.model, STATE))
    mujoco.mj_getState(task.model, engine.data, state, STATE)
    out: dict[str, Any] = {
        "version": VERSION,
        "task": config.task.rpartition("/")[2],
        "policy": config.policy.rpartition("/")[2],
        "task_config": json.dumps(settings.to_dict(config.task_config)),
        "policy_config": json.dumps(settings.to_dict(config.policy_config)),
        "generation": policy.generation,
        "mjcf": task.mjcf(),
        **_files(task),
        "mu": policy.parameters,
        "state": state,
        "state_kind": STATE,
        "x": batch.observe()[0],
        "steps": task.steps,
        "substeps": task.substeps,
        "control_period": task.period,
        "interface": json.dumps(interface(policy)),
        "gamma": task.config.gamma,
        "return_scale": task.return_scale,
        **({} if problem.policy.memory is None else {"memory": problem.policy.memory}),
    }
    for owner, more in (
        ("the policy's constants", problem.policy.constants),
        ("the task's exported()", task.exported()),
    ):
        _check_more(owner, more, {*out, "file"})
        out |= more
    return out


def _check_more(owner: str, more: object, names: Collection[str]) -> None:
    """Check what a plug-in adds to an exported policy.

    Raises:
      ConfigError: it is no table of arrays, numbers and texts, or one of these names.
    """
    if not isinstance(more, Mapping):
        raise ConfigError(f"{owner}: a {type(more).__name__}; expected arrays by name")
    for name, value in more.items():
        if name in names:
            raise ConfigError(f"{owner}: {name!r} is a part of each exported policy; rename it")
        if np.asarray(value).dtype.kind not in "biufUS":
            raise ConfigError(
                f"{owner}: {name!r} is a {type(value).__name__}; expected an array, number or text"
            )


def _files(task: Task) -> dict[str, Any]:
    """What the model reads, as bytes by path, and the model's own path; nothing if it reads
    nothing.
    """
    files = needed(task.mjcf(), task.sources, task.main)
    if len(files) == 1:
        return {}
    contents = {
        name: each.encode() if isinstance(each, str) else each for name, each in files.items()
    }
    return {"model": task.main} | {
        f"file/{name}": np.frombuffer(each, np.uint8) for name, each in contents.items()
    }


def write(path: Path, policy: LoadedPolicy) -> None:
    """Write the file, or leave an existing one; it holds arrays and texts, and needs no unpickling.

    Raises:
      ConfigError: the task has no MJCF text.
      RunError: it cannot be written.
    """
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **contents(policy))
    with writing(path):
        checkpoint.replace(path, content.getvalue())
