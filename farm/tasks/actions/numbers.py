"""An action's numbers: how many a task has, what they are, and whether something uses them."""

from typing import Final

from farm.errors import ConfigError
from farm.sim import quantities
from farm.sim.channels import Quantity
from farm.tasks.base import Task

LIMIT: Final = 10_000
"""Numbers of an action, at most."""


def described(task: Task, count: int) -> tuple[Quantity, ...]:
    """What the numbers of an action are: as the task names them, or by the actuators if there are
    as many.
    """
    if task.space:
        return task.space.quantities
    if isinstance(task.actions, tuple | list) and task.actions:
        return tuple(task.actions)
    bounds = (-1.0, 1.0) if type(task).act is Task.act else ()
    controls = quantities.controls(task.model)
    names = (
        [each.name for each in controls]
        if len(controls) == count
        else [f"action {i}" for i in range(count)]
    )
    return tuple(Quantity(name, "", *bounds) for name in names)


def is_size(value: object) -> bool:
    """Whether an attribute's value is a number of numbers."""
    return type(value) is int and 1 <= value <= LIMIT


def check(task: Task) -> None:
    """Check that an action has numbers, and that something uses them.

    Raises:
      ConfigError: says what is missing.
    """
    name = type(task).__name__
    if task.space:
        return
    size = task.action_size
    actuators = task.model.nu
    if not size:
        raise ConfigError(
            f"task {name}: its model has no actuator: say how many numbers an action has (actions ="
            " 3), and use them in act(self, sim, action)"
        )
    if size != actuators and type(task).act is Task.act:
        raise ConfigError(
            f"task {name}: actions have size {size}, but the model has {actuators or 'no'}"
            f" actuators: give it act(self, sim, action), which makes controls (B, {actuators}) of"
            f" actions (B, {size})"
        )
