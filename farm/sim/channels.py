"""Channels, the data that a rollout shows in addition to its bodies, measures and cameras.

Pure data.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from farm.arrays import AnyArray, FloatArray
from farm.errors import ConfigError

Kind = Literal["scalars", "flags", "images", "arrows", "points"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Channel:
    """Something that a rollout shows in addition to its bodies: n curves, pictures, arrows or
    points in each frame.

    Raises:
      ConfigError: its shape does not fit its kind, or a text, colour or limit is invalid.

    Example:
      ```python
      import farm

      labels = ("kinetic", "potential")
      energy = farm.Channel(name="energy", kind="scalars", shape=(2,), labels=labels, unit="J")
      force = farm.Channel(
          name="force", kind="arrows", shape=(1, 6), bodies=("tip",), unit="N", length=0.01
      )
      assert force.names == ("1",)
      ```
    """

    name: str
    """Path of the channel in recordings, for example `contacts/force`."""
    kind: Kind
    """The kind of data in a frame, with the shape:

    scalars (n,)        curves
    flags   (n,)        0 or 1, drawn as lanes
    images  (n, h, w)   pictures; with `places` also points on bodies
    arrows  (n, 6)      start [m], and vector [unit]
    points  (n, 4)      position [m], and value [unit]
    """
    shape: tuple[int, ...]
    """Shape of a frame."""
    labels: tuple[str, ...] = ()
    """Names of the n values; by default their numbers."""
    unit: str = ""
    top: float = 1.0
    """Value drawn in the brightest colour (images, points, painted geometries) [unit]."""
    colours: tuple[tuple[int, int, int], ...] = ()
    """Red, green, blue of each of the n, 0 to 255; by default from a palette."""
    bodies: tuple[str, ...] = ()
    """Bodies in whose frames the n arrows, points or places are; by default the world's frame."""
    places: FloatArray | None = None
    """Positions of an image's pixels on its body [m], (n, h * w, 3)."""
    length: float = 0.01
    """An arrow's length [m/unit]."""
    longest: float = 0.1
    """Longer arrows are cut here [m]."""
    geoms: tuple[str, ...] = ()
    """Geometries that a video paints by these n scalars: white at 0, their colour from `top` on."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Smallest and largest allowed value by label: drawn as constant lines with those scalars
    [unit].
    """
    bars: bool = False
    """Whether a video shows these scalars as bars, each between its limits, or from 0 to `top`."""
    trace: bool = False
    """Whether the channel's values are sent with results: of the best and the worst rollout of a
    generation, or of all.
    """

    def __post_init__(self) -> None:
        self._check_types()
        sizes = {"scalars": 1, "flags": 1, "images": 3, "arrows": 2, "points": 2}
        if self.kind not in sizes or len(self.shape) != sizes[self.kind]:
            raise ConfigError(
                f"channel {self.name}: kind {self.kind!r} of shape {self.shape}; see Channel.kind"
            )
        last = {"arrows": 6, "points": 4}.get(self.kind, self.shape[-1])
        if self.shape[-1] != last or min(self.shape) < 1:
            raise ConfigError(
                f"channel {self.name}: {self.kind} of shape {self.shape}; expected (n, {last})"
            )
        for what in ("labels", "colours", "bodies", "geoms"):
            if len(getattr(self, what)) not in (0, self.shape[0]):
                raise ConfigError(
                    f"channel {self.name}: {len(getattr(self, what))} {what} for {self.shape[0]}"
                )

        for what in ("top", "length", "longest"):
            value = getattr(self, what)
            if not finite(value) or value <= 0.0:
                raise ConfigError(
                    f"channel {self.name}: {what} is {value!r}; expected a positive number"
                )
        if self.bars and self.kind != "scalars":
            raise ConfigError(f"channel {self.name}: only scalars are bars, not {self.kind}")
        for label, limits in self.limits.items():
            two = (
                isinstance(limits, (tuple, list))
                and len(limits) == 2
                and all(isinstance(each, (int, float)) for each in limits)
            )
            if (
                self.kind != "scalars"
                or label not in self.names
                or not (two and -math.inf < limits[0] < limits[1] < math.inf)
            ):
                raise ConfigError(
                    f"channel {self.name}: limits {limits!r} of {label!r}; expected two rising"
                    f" finite numbers for scalars, by label: {', '.join(self.names)}"
                )

    def _check_types(self) -> None:
        """Check the types of what a task declares."""
        if not isinstance(self.name, str) or not self.name:
            raise ConfigError(f"channel {self.name!r}: its name must be a text")
        shape: object = self.shape
        if not isinstance(shape, tuple | list) or not all(type(each) is int for each in shape):
            raise ConfigError(
                f"channel {self.name}: shape is {shape!r}; expected a tuple of whole numbers, as"
                " (3,)"
            )
        for what in ("labels", "bodies", "geoms"):
            texts: object = getattr(self, what)
            if not isinstance(texts, tuple | list) or not all(
                isinstance(each, str) for each in texts
            ):
                raise ConfigError(
                    f"channel {self.name}: {what} is {texts!r:.60}; expected a tuple of texts"
                )
        for colour in self.colours:
            if (
                not isinstance(colour, tuple | list)
                or len(colour) != 3
                or not all(c in range(256) for c in colour)
            ):
                raise ConfigError(
                    f"channel {self.name}: colour {colour!r}; expected red, green, blue from 0"
                    " to 255"
                )

    def vectors(self, values: FloatArray) -> FloatArray:
        """Arrows' vectors (..., n, 3) as they are drawn, from values (..., n, 6) [m]."""
        vectors = values[..., 3:] * self.length
        extent = np.linalg.norm(vectors, axis=-1, keepdims=True)
        return vectors * np.minimum(1.0, self.longest / np.where(extent > 0, extent, 1.0))

    @property
    def names(self) -> tuple[str, ...]:
        """Labels, or numbers from 1."""
        return self.labels or tuple(str(i + 1) for i in range(self.shape[0]))


def flat(channels: Sequence[Channel], values: Mapping[str, AnyArray]) -> AnyArray:
    """Concatenate the channels' values (..., *shape) as float32, (..., K): a trace."""
    parts = [values[c.name].reshape(*values[c.name].shape[: -len(c.shape)], -1) for c in channels]
    return np.concatenate(parts, axis=-1).astype("<f4")


_OF_ALL_ROLLOUTS: Final = ("rollouts", "failed", "success", "return")
"""What tables say of any task's rollouts."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A number that describes a whole rollout beside its return: a height, a distance, a share of
    steps.

    Quality diversity keeps the best rollout for each of its values; constraints bound it.

    Raises:
      ConfigError: a text or the bounds are invalid.

    Example:
      ```python
      import farm

      class Leap(farm.Task):
          measures = (farm.Measure(name="height", low=0.0, high=2.0, unit="m"),)

          def outcomes(self, record):  # the highest of qpos' third number after any step
              return {"height": record.frames["qpos"][:, :, 2].max(axis=1).clip(0.0, 2.0)}
      ```
    """

    name: str
    low: float
    """Smallest value; also that of a rollout whose simulation became unstable."""
    high: float
    """Largest value."""
    unit: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ConfigError(f"measure {self.name!r}: expected a name of letters, digits and _")
        if self.name in _OF_ALL_ROLLOUTS:
            raise ConfigError(
                f"measure {self.name}: all rollouts have a number of this name beside their"
                " measures; call it otherwise"
            )
        bounds: tuple[object, ...] = (self.low, self.high)
        if (
            not all(isinstance(each, int | float) for each in bounds)
            or not -math.inf < self.low < self.high < math.inf
        ):
            raise ConfigError(
                f"measure {self.name}: bounds {self.low!r} to {self.high!r}; expected rising"
                " numbers"
            )


@dataclass(frozen=True)
class Quantity:
    """What one number of an observation or an action is; exported policies say it.

    Raises:
      ConfigError: a text or the range is invalid.

    Example:
      ```python
      import numpy as np

      import farm

      class Hinge(farm.Task):
          observations = (
              farm.Quantity("height", low=-1.0, high=1.0),
              farm.Quantity("speed", "rad/s"),
          )

          def observe(self, sim):  # (B, 2)
              return np.concatenate([np.cos(sim.qpos), sim.qvel], axis=1)
      ```
    """

    name: str
    unit: str = ""
    low: float = -math.inf
    """Smallest value; -inf if it is unknown."""
    high: float = math.inf
    """Largest value; inf if it is unknown."""

    def __post_init__(self) -> None:
        texts: tuple[object, ...] = (self.name, self.unit)
        if not all(isinstance(each, str) for each in texts) or not self.name:
            raise ConfigError(
                f"quantity {self.name!r} [{self.unit!r}]: expected a name and a unit as texts"
            )
        bounds: tuple[object, ...] = (self.low, self.high)
        if not all(isinstance(each, int | float) for each in bounds) or not self.low <= self.high:
            raise ConfigError(
                f"quantity {self.name}: {self.low!r} to {self.high!r}; expected rising numbers"
            )


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A point of view, in the parameters of MuJoCo's free camera.

    Example:
      ```python
      import farm

      class Seen(farm.Task):
          camera = farm.Camera(lookat=(0.0, 0.0, 0.3), distance=1.5, azimuth=90.0)
      ```
    """

    lookat: tuple[float, float, float]
    """[m]"""
    distance: float
    """[m]"""
    azimuth: float = 120.0
    """[deg]"""
    elevation: float = -15.0
    """[deg]"""

    def __post_init__(self) -> None:
        place: object = self.lookat
        numbers = (self.distance, self.azimuth, self.elevation)
        if not isinstance(place, tuple | list) or len(place) != 3 or not finite(*place, *numbers):
            raise ConfigError(
                f"camera: lookat {place!r:.60}, distance, azimuth, elevation {numbers!r:.60};"
                " expected three finite numbers, and three more"
            )
        if self.distance <= 0.0:
            raise ConfigError(f"camera: distance is {self.distance}; expected a positive number")


def finite(*values: object) -> bool:
    """Whether all values are finite numbers."""
    return all(isinstance(each, int | float) and math.isfinite(each) for each in values)
