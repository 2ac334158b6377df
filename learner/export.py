"""A learnt policy as one .npz that plain MuJoCo and numpy run; docs/export.md describes it."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import RunError
from farm.sim import scene as scenes
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.hand import FINGERS, JOINTS, LOWER, UPPER
from farm.tasks.finger_gait.rewards import WEIGHTS, Weights
from farm.tasks.finger_gait.task import CONTROL_PERIOD, SUBSTEPS
from learner.replay import Stored

VERSION: Final = 1
"""Version of the file."""

_UNCLIPPED: Final = 1e6  # [rad]; what limits an unclipped target, as in farm.policy


def contents(stored: Stored) -> dict[str, Any]:
    """Everything that the file holds, by name."""
    config, simulation = stored.config, stored.simulation
    task, policy = simulation.task, config.policy
    limits = (LOWER, UPPER) if policy.clip else (np.full(8, -_UNCLIPPED), np.full(8, _UNCLIPPED))
    start = simulation.start
    return {
        "version": VERSION,
        "generation": stored.generation,
        "mjcf": scenes.text(simulation.scene.object_name),
        "joints": np.array(JOINTS),
        "tips": np.array([f"{finger}_tip" for finger in FINGERS]),
        "controller": policy.controller,
        "bandwidth": policy.bandwidth,
        "action": policy.action,
        "mu": stored.mu,
        "W": stored.features.frequencies,
        "c": stored.features.phases,
        "lower": limits[0],
        "upper": limits[1],
        "start_command": task.commands,
        "state": start.rows[0],
        "state_kind": scenes.STATE,
        "x": task.observe(start.frames, None)[0],
        "input": task.config.state,
        "joints_scale": task.config.joints_scale,
        "contacts_scale": task.config.contacts_scale,
        "tactile_scale": task.config.tactile_scale,
        "taxels": tactile.DIRECTIONS,
        "kappa": tactile.KAPPA,
        "steps": task.config.steps,
        "substeps": SUBSTEPS,
        "control_period": CONTROL_PERIOD,
        "gamma": task.config.gamma,
        "return_scale": task.config.return_scale,
        "weights": _weights(task.config.reward, WEIGHTS[task.config.weights], task.goal.joints, task.goal.images),
        "punished_to": limits[1] - limits[0] if task.config.reward == "limited" else np.full(len(limits[0]), np.inf),
        "drop_penalty": WEIGHTS[task.config.weights].drop,
        "goal_joints": task.goal.joints,
        "goal_images": task.goal.images,
        "goal_points": task.goal.points,
    }


def write(path: Path, stored: Stored) -> None:
    """Write the file; it holds arrays and texts, nothing that has to be unpickled.

    Raises:
      RunError: it cannot be written.
    """
    try:
        with path.open("wb") as file:  # np.savez would add a suffix of its own
            np.savez_compressed(file, allow_pickle=False, **contents(stored))
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}") from None


def _weights(reward: str, weights: Weights, joints: FloatArray, images: FloatArray) -> FloatArray:
    """Factors of the squares that the reward takes off: tactile, joints, action, contact points, (4,)."""
    full = float(reward != "basic")
    touch = full * weights.tactile / float((images.reshape(-1) ** 2).sum())
    return np.array([touch, weights.joints / float((joints**2).sum()), weights.action, full * weights.contact_points])
