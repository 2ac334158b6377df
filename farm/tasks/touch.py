"""Touch by MuJoCo's own sensors, for any robot: readings of pads as pictures, with noise, delay and
interval.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.errors import ConfigError
from farm.settings import setting
from farm.sim.channels import Channel
from farm.sim.sim import Sim
from farm.tasks.base import TaskConfig

# Numbers of a contact's fields, in MuJoCo's order: found, force, ...
_FIELDS: Final = (1, 3, 3, 1, 3, 3, 3, 3, 3)
_FOUND, _FORCE = 0, 1
_SENSOR: Final = ("type", "adr", "dim", "objid", "refid")


@dataclass(frozen=True, kw_only=True)
class TouchConfig(TaskConfig):
    """Settings of a task with touch; a task's own `Config` adds to them.

    Example:
      ```python
      from dataclasses import dataclass

      import farm

      class Feeling(farm.Task):
          @dataclass(frozen=True, kw_only=True)
          class Config(farm.TouchConfig):
              weight: float = farm.setting(0.1, above=0.0)
              '''Of what is lifted [kg]; --touch-noise, --touch-delay and --touch-interval are flags
              as well.'''
      ```
    """

    touch_noise: float = setting(0.0, least=0.0, most=1e6)
    """Standard deviation of the noise of each number that is felt [its unit]; none under nominal
    conditions.
    """
    touch_delay: int = setting(0, least=0, most=1000)
    """Control steps by which readings are late."""
    touch_interval: int = setting(1, least=1, most=1000)
    """Control steps from one reading to the next; the last one holds in between."""


class Touch:
    """What pads of a robot feel: numbers of the model's sensors, as a picture for each pad.

    A number is the force on a site (sensor `touch`, [N]), the sum of the normal forces of a
    `contact` sensor with `data="found force"` ([N]), the normal force in a part of the field of
    MuJoCo's plug-in `mujoco.sensor.touch_grid` ([N]), or how deep something is in a vertex of a
    mesh (`tactile`, [m]).

    Example:
      ```python
      from functools import cached_property

      import farm

      class Press(farm.Task):
          Config = farm.TouchConfig
          xml = '''<mujoco>
            <worldbody>
              <geom type="plane" size="1 1 1"/>
              <body name="pad" pos="0 0 0.1">
                <joint name="z" type="slide" axis="0 0 1"/>
                <geom type="box" size="0.1 0.1 0.1" mass="1"/>
                <site name="left" pos="-0.1 0 -0.1" size="0.12"/>
                <site name="right" pos="0.1 0 -0.1" size="0.12"/>
              </body>
            </worldbody>
            <actuator><motor joint="z" ctrlrange="-5 5"/></actuator>
            <sensor><touch name="left" site="left"/><touch name="right" site="right"/></sensor>
          </mujoco>'''

          @cached_property
          def touch(self):
              pads = {"pad": ("left", "right")}
              return farm.Touch(self.model, pads, self.config, self.steps, top=20.0)

          @cached_property
          def channels(self):
              return (self.touch.channel,)

          def reset(self, sim, row, rng):
              self.touch.reset(sim, row, rng)

          def observe(self, sim):
              return self.touch.felt(sim)  # (B, 2)

          def measure(self, sim):
              return {"touch": self.touch.true(sim)}

          def reward(self, sim, action):
              return sim.qpos[:, 0]

      assert Press().touch.channel.shape == (1, 1, 2)
      ```
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        pads: Mapping[str, Sequence[str]],
        config: TouchConfig,
        steps: int,
        *,
        shape: tuple[int, int] | None = None,
        top: float = 1.0,
        name: str = "touch",
    ) -> None:
        """Find the sensors.

        Args:
          model: the task's.
          pads: names of the sensors of each pad; their numbers fill its picture row by row.
          config: noise, delay and interval.
          steps: control steps of a rollout.
          shape: height and width of a picture; by default those of the grid, if each pad has one,
              or one row.
          top: number that is drawn in the brightest colour.
          name: of the channel, and of what is kept in `sim.own`.

        Raises:
          ConfigError: there is no such sensor, it is of another kind, or the numbers do not fill
              the pictures.
        """
        self._config, self._steps, self._name = config, steps, name
        by_pad = [[_sensor(model, sensor) for sensor in sensors] for sensors in pads.values()]
        counts = [sum(len(each.at) for each in pad) for pad in by_pad]
        grids = {pad[0].shape if len(pad) == 1 else None for pad in by_pad}
        grid = grids.pop() if len(grids) == 1 else None
        height, width = shape or grid or (1, counts[0] if counts else 0)
        if not counts or set(counts) != {height * width}:
            raise ConfigError(
                f"touch: the pads' sensors give {', '.join(map(str, counts)) or 'no'} numbers;"
                f" expected {height} x {width} for each"
            )
        sensors = [each for pad in by_pad for each in pad]
        units = {each.unit for each in sensors}
        if len(units) > 1:
            raise ConfigError(
                f"touch: the sensors' units are {' and '.join(sorted(units))}; expected one"
            )
        self._at = np.concatenate([each.at.ravel() for each in sensors])
        self._found = np.concatenate([each.found.ravel() for each in sensors])
        slots = [each.at.shape[1] for each in sensors for _ in each.at]
        self._first = np.cumsum([0, *slots[:-1]])  # where each number's slots begin, (n,)
        places = [_places(model, pad) for pad in by_pad]
        where: dict[str, Any] = {}
        if all(place is not None for place in places):
            where = {
                "bodies": tuple(p[0] for p in places if p),
                "places": np.stack([p[1] for p in places if p]),
            }
        self.channel = Channel(
            name=name,
            kind="images",
            shape=(len(by_pad), height, width),
            labels=tuple(pads),
            top=top,
            unit=units.pop(),
            trace=True,
            **where,
        )
        """What shows the true readings; on the pads too, if each is on one body with a name."""

    def true(self, sim: Sim) -> FloatArray:
        """Present readings (B, pads, height, width), without noise, delay and interval."""
        data = sim.sensordata
        values = np.where(data[:, self._found] > 0, data[:, self._at], 0.0)
        return np.add.reduceat(values, self._first, axis=1).reshape(-1, *self.channel.shape)

    def reset(self, sim: Sim, row: int, rng: np.random.Generator | None) -> None:
        """Draw a rollout's noise; called in the task's `reset` or `prepare`."""
        shape = (self._steps + 1, len(self._first))
        noise = sim.own.setdefault(f"{self._name} noise", np.zeros((len(sim), *shape)))
        sim.own.setdefault(f"{self._name} readings", np.zeros((len(sim), *shape)))
        if rng is not None and self._config.touch_noise:
            noise[row] = rng.normal(0.0, self._config.touch_noise, shape)

    def felt(self, sim: Sim) -> FloatArray:
        """Return what a policy feels (B, n), n = pads x height x width: called in `observe`, once
        or more in each step.
        """
        readings, interval = sim.own[f"{self._name} readings"], self._config.touch_interval
        readings[:, sim.t] = self.true(sim).reshape(len(sim), -1)
        at = max(0, sim.t // interval * interval - self._config.touch_delay)
        return readings[:, at] + sim.own[f"{self._name} noise"][:, at]


@dataclass(frozen=True)
class _Sensor:
    """One sensor of touch."""

    at: IntArray
    """Indices in sensordata of n numbers, each the sum of k: (n, k)"""
    found: IntArray
    """Indices of numbers that are above 0 where those count, (n, k)"""
    unit: str
    body: int
    places: FloatArray
    """Where the numbers are felt in the body's frame [m], (n, 3)"""
    shape: tuple[int, int] | None = None
    """Height and width of the numbers' grid, if they have one."""


def _sensor(model: mujoco.MjModel, name: str) -> _Sensor:
    i = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if i < 0:
        raise ConfigError(f"touch: there is no sensor {name!r} in the model")
    kind, first, size, of, other = (int(getattr(model, f"sensor_{name}")[i]) for name in _SENSOR)
    what = mujoco.mjtSensor(kind).name.removeprefix("mjSENS_").lower()
    if what == "touch":
        at = np.array([[first]])
        return _Sensor(at, at, "N", int(model.site_bodyid[of]), model.site_pos[of][None].copy())
    if what == "tactile":
        # Depths come first, then two slips of each vertex
        at = first + np.arange(size // 3)[:, None]
        start, count = int(model.mesh_vertadr[of]), int(model.mesh_vertnum[of])
        places = _turned(model, other, model.mesh_vert[start : start + count])
        return _Sensor(at, at, "m", int(model.geom_bodyid[other]), places)
    if what == "contact":
        fields = [bit for bit in range(len(_FIELDS)) if int(model.sensor_intprm[i, 0]) >> bit & 1]
        if _FOUND not in fields or _FORCE not in fields:
            raise ConfigError(f'touch: contact sensor {name!r} needs data="found force"')
        slots = first + np.arange(0, size, sum(_FIELDS[bit] for bit in fields))[None]
        geom = of if model.sensor_objtype[i] == mujoco.mjtObj.mjOBJ_GEOM else -1
        place = np.zeros((1, 3)) if geom < 0 else model.geom_pos[geom][None].copy()
        return _Sensor(
            slots + 1, slots, "N", int(model.geom_bodyid[geom]) if geom >= 0 else 0, place
        )
    if what == "plugin" and (grid := _grid(model, i)) is not None:
        # Normal forces come first, then other forces and torques
        at = first + np.arange(grid.count)[:, None]
        places = (
            model.site_pos[of]
            + grid.directions() @ _matrix(model.site_quat[of]).T * model.site_size[of, 0]
        )
        return _Sensor(at, at, "N", int(model.site_bodyid[of]), places, (grid.height, grid.width))
    raise ConfigError(
        f"touch: sensor {name!r} is of kind {what}; expected touch, contact, tactile or touch_grid"
    )


@dataclass(frozen=True)
class _Grid:
    """The field of a touch_grid: a part of it for each number, row by row from the lowest y."""

    width: int
    height: int
    field: tuple[float, float]
    """Largest angles from its middle along x and y [deg]."""
    fovea: float
    """0: all parts see equal angles; up to 1: those in the middle see smaller ones."""

    @property
    def count(self) -> int:
        """Number of its parts."""
        return self.width * self.height

    def directions(self) -> FloatArray:
        """Unit vectors to the parts' middles in the frame of the site, which looks along -z,
        (count, 3).
        """
        angles = []
        for parts, most in zip((self.width, self.height), self.field, strict=True):
            middle = (np.arange(parts) + 0.5) * 2.0 / parts - 1.0
            angles.append(np.deg2rad(most) * (self.fovea * middle**5 + (1.0 - self.fovea) * middle))
        y, x = (each.ravel() for each in np.meshgrid(angles[1], angles[0], indexing="ij"))
        return np.stack([np.cos(y) * np.sin(x), np.sin(y), -np.cos(y) * np.cos(x)], axis=1)


def _grid(model: mujoco.MjModel, sensor: int) -> _Grid | None:
    """The grid of a plug-in's sensor; None if it is another plug-in.

    MjModel has no names of plug-ins, but the values of their attributes: here nchannel, size, fov
    and gamma.
    """
    instance = int(model.sensor_plugin[sensor])
    first, *after = model.plugin_attradr[instance : instance + 2].tolist()
    text = model.plugin_attr[first : after[0] if after else None].tobytes()
    try:
        channels, size, field, fovea, _ = text.decode().split("\0")
        width, height = map(int, size.split())
        along_x, along_y = map(float, field.split())
        # What the model leaves out is empty; the plug-in then takes 0.
        grid = _Grid(width, height, (along_x, along_y), float(fovea or 0.0))
    except ValueError:
        return None
    return grid if grid.count * float(channels or 1) == model.sensor_dim[sensor] else None


def _matrix(quaternion: FloatArray) -> FloatArray:
    """The rotation of a quaternion wxyz, (3, 3)."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, quaternion)
    return turn.reshape(3, 3)


def _turned(model: mujoco.MjModel, geom: int, vertices: FloatArray) -> FloatArray:
    """Vertices (V, 3) in a geometry's frame, in that of its body."""
    return model.geom_pos[geom] + vertices @ _matrix(model.geom_quat[geom]).T


def _places(model: mujoco.MjModel, pad: Sequence[_Sensor]) -> tuple[str, FloatArray] | None:
    """Name of a pad's body and its places there (n, 3); None if it is on several, or on none with a
    name.
    """
    bodies = {each.body for each in pad}
    name = model.body(pad[0].body).name if len(bodies) == 1 else ""
    return (
        (name, np.concatenate([each.places for each in pad])) if name and 0 not in bodies else None
    )
