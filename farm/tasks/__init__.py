"""Tasks by name, and what learner, workers and recorders ask them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from farm.tasks.base import Sizes
from farm.tasks.finger_gait import task as finger_gait
from farm.tasks.finger_gait.task import TaskConfig

if TYPE_CHECKING:
    from farm.sim.scene import Scene


@dataclass(frozen=True)
class Task:
    """What is known of a kind of task without simulating it."""

    sizes: Callable[[TaskConfig], Sizes]
    scene: "Callable[[TaskConfig], Scene]"
    """What there is to draw."""


# MuJoCo and Gymnasium are loaded when they are asked: whoever only reads a configuration needs neither.
def _hand(config: TaskConfig) -> "Scene":
    from farm.sim import scene

    return scene.load(config.object)


def _environment_sizes(config: TaskConfig) -> Sizes:
    from farm import gym

    return gym.sizes(config)


def _environment_scene(config: TaskConfig) -> "Scene":
    from farm import gym

    return gym.scene(config)


TASKS: Final = {
    "finger-gait": Task(finger_gait.sizes, _hand),
    "gym": Task(_environment_sizes, _environment_scene),
}
"""Kinds of tasks, the part before a colon of a task's name; a run's specification names one, never code."""


def sizes(config: TaskConfig) -> Sizes:
    """How large the task's numbers are.

    Raises:
      ConfigError: it is not to be had on this machine.
    """
    return TASKS[config.kind].sizes(config)


def scene(config: TaskConfig) -> "Scene":
    """What there is to draw.

    Raises:
      ConfigError: it is not to be had on this machine.
    """
    return TASKS[config.kind].scene(config)
