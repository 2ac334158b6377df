"""Things that many tests need, made in one place: what a test says of them is what it is about."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from farm import plugins
from farm.net.messages import Spec
from farm.net.stats import GenerationStats
from farm.net.telemetry import Report
from farm.runner import SIMULATION
from farm.sim.trajectory import Trajectory
from learner.algorithms import PGPE
from learner.run.checkpoint import Checkpoint
from learner.run.config import RunConfig, to_dict

POLE = """
import numpy as np
import farm

class Pole(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="j"/></actuator></mujoco>'''
    steps = 4

    def reward(self, sim, action):
        return np.cos(sim.qpos[:, 0])
"""
"""A small task in a file: as a user writes one."""


def pole(folder: Path, text: str = POLE, name: str = "pole.py") -> Path:
    """The file of that task, in a folder that need not be there."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def spec(**changed: Any) -> Spec:
    """What a learner says of a run, whose task and policy nobody has."""
    values = {
        "run": "r",
        "task": "none",
        "task_config": {},
        "policy": "none",
        "policy_config": {},
        "code": {},
    }
    return Spec(**(values | changed))


def spec_of(file: Path, policy: str = "kernel", **changed: Any) -> Spec:
    """What a learner says of a run with the task in that file."""
    task, acts = plugins.find("tasks", f"{file}:Pole"), plugins.find("policies", policy)
    code = {
        "task": task.digest(),
        "policy": acts.digest(),
        "simulation": plugins.code_digest(SIMULATION),
    }
    values = {
        "task": task.wire,
        "policy": policy,
        "code": code,
        "files": {"model.xml": task.target.xml},
    }
    return spec(**(values | changed))


def stats(generation: int = 1, **changed: Any) -> GenerationStats:
    """Statistics of a generation."""
    values: dict[str, Any] = {
        "generation": generation,
        "rollouts": 30 * generation,
        "return_mean": -5.0 + 0.1 * generation,
        "return_min": -40.0,
        "return_max": -1.0,
        "return_std": 2.5,
        "best": -0.5,
        "baseline": -5.0,
        "mean_policy_return": -4.0,
        "mean_policy_success": False,
        "success_rate": 0.25,
        "sigma_mean": 2.0,
        "sigma_min": 1.0,
        "sigma_max": 3.0,
        "mean_norm": 8.0,
        "ended": 2,
        "failed": 0,
        "clamped": 0,
        "reissued": 1,
        "workers": 3,
        "seconds": 2.0 * generation,
    }
    return GenerationStats(**(values | changed))


def report(
    progress: GenerationStats,
    sample: Trajectory | None = None,
    traces: Mapping[str, Any] | None = None,
    **more: Any,
) -> Report:
    """A generation's report, of one exploring rollout per second."""
    return Report(
        **{
            "progress": progress,
            "rate": 1.0,
            "sample": sample,
            "traces": dict(traces or {}),
            **more,
        }
    )


def checkpoint(**changed: Any) -> Checkpoint:
    """A run's checkpoint, before its first generation."""
    values: dict[str, Any] = {
        "run": "r",
        "config": to_dict(RunConfig()),
        "state": PGPE().init(5).to_dict(),
        "rollouts": 0,
        "reissued": 0,
        "seconds": 0.0,
        "solved": 0,
        "best": None,
        "best_generation": 0,
        "fingerprint": "c",
        "replayed": True,
        "code": {},
        "files": {},
        "constants": {},
    }
    return Checkpoint(**(values | changed))
