"""The base class of action spaces: what the numbers of an action do, and what is seen of it."""

from collections.abc import Iterator, Sequence
from copy import copy
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import ConfigError
from farm.sim.channels import Quantity

if TYPE_CHECKING:
    import mujoco

    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class ActionSpace:
    """What the numbers of a task's actions do; a task's `actions` may be one.

    A subclass has `fit` and `controls`. What it must remember of a rollout is kept in `sim.own`, as
    by a task; the object itself belongs to the task and is equal in all rollouts.

    Example:
      ```python
      import numpy as np

      import farm

      class Halves(farm.ActionSpace):
          '''All actuators get half of one number.'''

          def fit(self, task):
              self.count = task.model.nu
              self.quantities = (farm.Quantity("all", low=-1.0, high=1.0),)

          def controls(self, sim, action):  # (B, 1) -> (B, nu)
              return np.repeat(0.5 * action, self.count, axis=1)

      class Hinge(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body><joint name="hinge"/><geom size="0.1"/></body>
            </worldbody>
            <actuator><motor joint="hinge"/></actuator>
          </mujoco>'''
          actions = Halves()

      assert Hinge().action_size == 1
      ```
    """

    quantities: tuple[Quantity, ...] = ()
    """What the numbers of an action are; their count is its size."""

    def fit(self, task: "Task") -> None:
        """Take what is needed from a task's model, and set `quantities`.

        Raises:
          ConfigError: it does not fit the model.
        """
        raise NotImplementedError

    def begin(self, sim: "Sim") -> None:
        """Put what is remembered into `sim.own`, (B, ...).

        The task prepares the starts afterwards.
        """

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls (B, nu) of raw actions (B, A); may write states, as a task's `act`."""
        raise NotImplementedError

    def see(self, sim: "Sim", x: FloatArray) -> FloatArray:  # noqa: ARG002
        """What the policy sees (B, d) when the task observes x (B, n): with a phase, for
        example.
        """
        return x

    def names(self, observations: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
        """What the numbers of `see` are, d of them, when the task's n are these."""
        return observations

    @property
    def size(self) -> int:
        """Length A of an action."""
        return len(self.quantities)

    def fitted(self, task: "Task") -> "ActionSpace":
        """Copy this action space and fit the copy to a task.

        Raises:
          ConfigError: the action space does not fit the task's model.
        """
        space, _ = copy(self), task.simulated  # a model that cannot be made says so itself
        try:
            space.fit(task)
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            if not all(type(each).__module__.startswith("farm.") for each in space.parts()):
                raise  # the author of one needs the place
            kind, whose = type(self).__name__, type(task).__name__
            raise ConfigError(
                f"{kind}: an argument is of the wrong kind for task {whose} ({error}); expected"
                f" those of help(farm.{kind})"
            ) from None
        return space

    def parts(self) -> Iterator["ActionSpace"]:
        """This space, and those that it is made of."""
        yield self
        if isinstance(of := getattr(self, "of", None), ActionSpace):
            yield from of.parts()


class Actuators(ActionSpace):
    """One number for each actuator, -1 to 1 rescaled to its range: what a task has that says
    nothing.
    """

    def fit(self, task: "Task") -> None:
        """Take the actuators' ranges."""
        self.limits = task.limits
        self.quantities = unit(actuators(task.model))

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:  # noqa: ARG002
        """Controls (B, nu) of actions (B, nu)."""
        return rescaled(action, *self.limits)


class Around(ActionSpace):
    """An action space made of another, whose memory and observations it keeps."""

    of: ActionSpace

    def fit(self, task: "Task") -> None:
        """Fit the space that it is made of."""
        if not isinstance(self.of, ActionSpace):
            raise ConfigError(
                f"{type(self).__name__}: it is made of {self.of!r:.60}; expected an action space,"
                " such as farm.Offsets()"
            )
        self.of = self.of.fitted(task)

    def begin(self, sim: "Sim") -> None:
        """Begin the other action space."""
        self.of.begin(sim)

    def see(self, sim: "Sim", x: FloatArray) -> FloatArray:
        """Return what the policy sees with the other action space, (B, d)."""
        return self.of.see(sim, x)

    def names(self, observations: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
        """Names of what is seen with the other."""
        return self.of.names(observations)


def clipped(action: FloatArray) -> FloatArray:
    """Numbers of an action within -1 and 1; nan is 0."""
    part = np.minimum(np.maximum(action, -1.0), 1.0)
    part[np.isnan(part)] = 0.0
    return part


def rescaled(action: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Raw actions (B, A) scaled to limits (A,): -1 or less is the lowest, 1 or more the highest.

    A nan is the middle.
    """
    return low + (high - low) * (0.5 * (clipped(action) + 1.0))


def ranges(model: "mujoco.MjModel") -> tuple[FloatArray, FloatArray]:
    """Smallest and largest control of each actuator, (nu,) each; infinite if it has no range."""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return np.where(limited, low, -np.inf), np.where(limited, high, np.inf)


def listed(names: str | Sequence[str]) -> tuple[str, ...]:
    """Names, of which one may be given alone."""
    return (names,) if isinstance(names, str) else tuple(names)


def unit(names: Sequence[str]) -> tuple[Quantity, ...]:
    """Quantities of these names from -1 to 1."""
    return tuple(Quantity(name, "", -1.0, 1.0) for name in names)


def actuators(model: "mujoco.MjModel") -> list[str]:
    """Names of a model's actuators, or of what they move."""
    from farm.sim.quantities import controls

    return [each.name for each in controls(model)]


def chosen(owner: str, model: "mujoco.MjModel", patterns: Sequence[str]) -> IntArray:
    """Indices of the actuators whose names match one of the patterns, such as `FR_*`, or all of
    them without any.

    Raises:
      ConfigError: a pattern matches none.
    """
    names = actuators(model)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            available = ", ".join(names)
            raise ConfigError(
                f"{owner}: no actuator is called {pattern!r}; the model has {available}"
            )
    if not patterns:
        return np.arange(len(names))
    selected = [any(fnmatchcase(name, pattern) for pattern in patterns) for name in names]
    return np.flatnonzero(selected)


def spread(owner: str, what: str, values: float | Sequence[float], count: int) -> FloatArray:
    """A number for each of `count`, (count,), from one for all or one for each.

    Raises:
      ConfigError: there are others, or one is not finite and above 0.
    """
    array = np.asarray(values, dtype=float)
    if array.shape not in ((), (count,)) or not np.isfinite(array).all() or (array <= 0.0).any():
        raise ConfigError(
            f"{owner}: {what} is {values!r:.60}; expected a number above 0, or {count} of them"
        )
    return np.broadcast_to(array, (count,))
