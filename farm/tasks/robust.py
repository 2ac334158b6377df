"""What a policy must be robust against: ranges of sensor errors, delays, motors, masses, friction
and pushes.

Pure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError

Range = tuple[float, float]
"""Lowest and highest value."""

SIZES: Final = ("noise", "bias")
"""Causes that are sizes of errors of the observation."""

NEUTRAL: Final = {
    "observation_delay": 0.0,
    "action_delay": 0.0,
    "motors": 1.0,
    "mass": 1.0,
    "payload": 0.0,
    "friction": 1.0,
    "push": 0.0,
}
"""Causes that are ranges, and what each is without it."""

CAUSES: Final = (*SIZES, *NEUTRAL)

UNITS: Final = {"observation_delay": "s", "action_delay": "s", "payload": "kg", "push": "N"}

PHYSICAL: Final = ("motors", "mass", "payload", "friction", "push")
"""Causes that change the physics, and not only what the policy sees or when it acts."""

_LEAST: Final = 0.05  # of a factor at more than the declared strength
_LARGE: Final = 1e6


@dataclass(frozen=True, kw_only=True)
class Robust:
    """Conditions that differ between rollouts, drawn from each one's seed; none at the nominal
    start.

    A task declares them once, as `robust = farm.Robust(...)`. They come after the task's own
    `reset`, whose numbers stay as they are, and both rollouts of a pair have the same ones.
    `--robust 0` turns them off, `--robust 2` doubles their distance from none. A policy sees, and a
    run records and normalises, the observations with errors and delay.

    Raises:
      ConfigError: a range falls, or a number makes no sense.

    Example:
      ```python
      import farm

      class Hinge(farm.Task):
          xml = '''<mujoco>
            <worldbody>
              <body name="rod">
                <joint name="hinge" axis="0 1 0"/>
                <geom size="0.1" pos="0 0 1"/>
              </body>
            </worldbody>
            <actuator><motor joint="hinge" ctrlrange="-2 2"/></actuator>
          </mujoco>'''
          steps, substeps = 100, 10
          robust = farm.Robust(
              noise=(0.01, 0.1),  # of the angle [rad] and the speed [rad/s]
              observation_delay=(0.0, 0.04),  # [s]
              motors=(0.8, 1.2),
              push=(0.0, 5.0),  # [N]
              body="rod",
          )

      assert Hinge.robust.causes == ("noise", "observation_delay", "motors", "push")
      assert Hinge.robust.scaled(0.5).motors == (0.9, 1.1)
      ```
    """

    noise: float | Sequence[float] = 0.0
    """Standard deviation of the error that each observed number has anew in each control step [its
    own unit]: one for all, one for each of `Task.parts`, or one for each number.
    """
    bias: float | Sequence[float] = 0.0
    """Largest error of each observed number that stays during a rollout, uniform to both sides;
    likewise.
    """
    observation_delay: Range = (0.0, 0.0)
    """Age of what the policy sees [s]; between two control steps it is interpolated."""
    action_delay: Range = (0.0, 0.0)
    """From an action to its effect [s]; likewise.

    Before the first one arrives, the first one is in effect.
    """
    motors: Range = (1.0, 1.0)
    """Factor of each actuator's force and of its limit: of a servo's stiffness and damping, and not
    of its target.
    """
    mass: Range = (1.0, 1.0)
    """Factor of all masses and inertias."""
    payload: Range = (0.0, 0.0)
    """Mass added at the centre of mass of `body` [kg]."""
    friction: Range = (1.0, 1.0)
    """Factor of the friction of all contacts."""
    push: Range = (0.0, 0.0)
    """Horizontal force on `body` [N], at times and in directions that are drawn."""
    push_duration: float = 0.2
    """How long it lasts [s]; in whole control steps, at least one."""
    pushes: int = 1
    """How often in a whole rollout, once in each of as many equal parts of it."""
    body: str = ""
    """Name of the body that has the payload and is pushed; empty: the first that a joint moves."""

    def __post_init__(self) -> None:
        for name in SIZES:
            object.__setattr__(self, name, _sizes(name, getattr(self, name)))
        for name, neutral in NEUTRAL.items():
            object.__setattr__(self, name, _range(name, getattr(self, name), factor=neutral == 1.0))
        if not _number(self.push_duration) or not 0.0 < self.push_duration <= _LARGE:
            raise ConfigError(
                f"robust: push_duration is {self.push_duration!r}; expected a positive number of"
                " seconds"
            )
        if type(self.pushes) is not int or not 1 <= self.pushes <= 1000:
            raise ConfigError(
                f"robust: pushes is {self.pushes!r}; expected a whole number from 1 to 1000"
            )
        if not isinstance(self.body, str):
            raise ConfigError(f"robust: body is {self.body!r}; expected the name of a body")

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of what differs between rollouts."""
        sizes = [name for name in SIZES if any(np.ravel(getattr(self, name)))]
        return (
            *sizes,
            *(
                name
                for name, neutral in NEUTRAL.items()
                if getattr(self, name) != (neutral, neutral)
            ),
        )

    def only(self, cause: str) -> "Robust":
        """One cause alone."""
        sizes = {name: 0.0 for name in SIZES if name != cause}
        return replace(
            self, **sizes, **{name: (each, each) for name, each in NEUTRAL.items() if name != cause}
        )  # type: ignore[arg-type]

    def scaled(self, strength: float) -> "Robust":
        """Ranges whose distance from none is this number of times as large; a factor is at least
        0.05.
        """
        if strength == 1.0:
            return self
        sizes = {
            name: tuple(strength * size for size in np.ravel(getattr(self, name)).tolist())
            for name in SIZES
        }
        ranges = {}
        for name, neutral in NEUTRAL.items():
            values = (neutral + strength * (value - neutral) for value in getattr(self, name))
            ranges[name] = tuple(max(value, _LEAST) if neutral else value for value in values)
        return replace(self, **sizes, **ranges)  # type: ignore[arg-type]

    def sizes(self, cause: str, count: int, parts: Sequence[int] = ()) -> FloatArray:
        """Sizes of the errors of each observed number, (d,).

        Args:
          cause: one of SIZES.
          count: observed numbers, d.
          parts: sizes of the observation's parts.

        Raises:
          ConfigError: the sizes fit neither the numbers nor the parts.
        """
        values = np.ravel(getattr(self, cause))
        if len(values) in (1, count):
            return np.broadcast_to(values, (count,)).copy()
        if len(values) == len(parts) and sum(parts) == count:
            return np.repeat(values, parts)
        of_parts = f", {len(parts)} (one for each part)" if parts else ""
        raise ConfigError(
            f"robust: {cause} has {len(values)} numbers; expected 1{of_parts} or {count} (one for"
            " each observed number)"
        )

    def said(self, cause: str) -> str:
        """A cause's range in words: "0 to 0.04 s"."""
        value = getattr(self, cause)
        if cause in NEUTRAL:
            unit = f" {UNITS[cause]}" if cause in UNITS else ""
            return f"{value[0]:.3g} to {value[1]:.3g}{unit}"
        sizes = sorted(set(np.ravel(value).tolist()))
        return f"{sizes[0]:.2g} to {sizes[-1]:.2g}" if len(sizes) > 1 else f"{sizes[0]:.3g}"


def _number(value: object) -> bool:
    return (
        isinstance(value, int | float | np.number)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def _sizes(name: str, value: object) -> float | tuple[float, ...]:
    """Sizes of errors as a number, or a tuple of numbers."""
    if _number(value):
        values = [value]
    else:
        values = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(values, list | tuple) or not values or not all(map(_number, values)):
        raise ConfigError(
            f"robust: {name} is {value!r:.60}; expected a number, or one for each observed number"
        )
    if bad := [each for each in values if not 0.0 <= each <= _LARGE]:
        raise ConfigError(f"robust: {name} is {bad[0]:g}; expected a size from 0 to {_LARGE:g}")
    return float(values[0]) if len(values) == 1 else tuple(map(float, values))


def _range(name: str, value: object, *, factor: bool) -> Range:
    """A range as two numbers."""
    ends = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(map(_number, ends)):
        raise ConfigError(f"robust: {name} is {value!r:.60}; expected a range, as (0.8, 1.2)")
    low, high = map(float, ends)
    if low > high:
        raise ConfigError(f"robust: {name} is {low:g} to {high:g}; expected the lower end first")
    if low < 0.0 or (factor and low == 0.0) or high > _LARGE:
        expected = "factors above 0" if factor else f"0 to {_LARGE:g}"
        raise ConfigError(f"robust: {name} is {low:g} to {high:g}; expected {expected}")
    return low, high
