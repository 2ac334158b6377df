"""Arrows and points of channels, put into a scene that MuJoCo's renderer draws."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.sim.channels import Channel
from farm.sim.scene import Scene

POINT_RADIUS: Final = 0.0085
"""Radius of a pixel that is drawn on its body, in radii of the scene; points are twice as large."""
ARROW_RADIUS: Final = 0.012
"""Radius of an arrow, in radii of the scene."""

_DARK: Final = (60, 60, 60)  # arrows without colours: white ones would not be seen here
_PAINT: Final = (213, 94, 0)  # points without colours


class Marks:
    """Marks that a task's channels of arrows, points, and pictures with places add to a scene."""

    def __init__(self, scene: Scene, channels: Sequence[Channel]) -> None:
        """Take those that can be drawn; a ConfigError if one names a body that the scene does
        not have.
        """
        self._radius = scene.radius
        self._channels = [
            each
            for each in channels
            if each.kind in ("arrows", "points") or each.places is not None
        ]
        self._bodies = {
            each.name: [scene.number(body) for body in each.bodies] for each in self._channels
        }

    def put(
        self, scene: mujoco.MjvScene, data: mujoco.MjData, values: Mapping[str, FloatArray]
    ) -> None:
        """Add one frame's to the scene, as long as it has room.

        Args:
          scene: the renderer's scene.
          data: where the bodies are.
          values: of the channels by name, of their shapes.
        """
        for channel in self._channels:
            marks = self._arrows if channel.kind == "arrows" else self._points
            for add in marks(channel, values[channel.name], data):
                if scene.ngeom < scene.maxgeom:
                    _add(scene, **add)

    def _arrows(
        self, channel: Channel, values: FloatArray, data: mujoco.MjData
    ) -> Iterator[dict[str, Any]]:
        vectors, colours = channel.vectors(values), channel.colours or [_DARK] * len(values)
        for i, (start, vector, colour) in enumerate(
            zip(values[:, :3], vectors, colours, strict=True)
        ):
            tail = self._in_world(channel, i, start, data)
            tip = self._in_world(channel, i, start + vector, data)
            if vector.any():
                yield {
                    "place": tail,
                    "tip": tip,
                    "radius": ARROW_RADIUS * self._radius,
                    "colour": glow(1.0, colour),
                }

    def _points(
        self, channel: Channel, values: FloatArray, data: mujoco.MjData
    ) -> Iterator[dict[str, Any]]:
        colours = channel.colours or [_PAINT] * len(values)
        for i, colour in enumerate(colours):
            if channel.kind == "points":
                places, readings, radius = values[i, None, :3], values[i, 3:], 2 * POINT_RADIUS
            else:
                assert channel.places is not None
                readings = values[i].ravel()
                places = channel.places[i][readings > 0]
                readings = readings[readings > 0]
                radius = POINT_RADIUS
            for place, value in zip(places, readings.tolist(), strict=True):
                rgba = glow(value / channel.top, colour)
                centre = self._in_world(channel, i, place, data)
                yield {
                    "place": centre,
                    "tip": None,
                    "radius": radius * self._radius,
                    "colour": rgba,
                }

    def _in_world(
        self, channel: Channel, i: int, place: FloatArray, data: mujoco.MjData
    ) -> FloatArray:
        """A place (3,) of the channel's i-th value in the world."""
        bodies = self._bodies[channel.name]
        if not bodies:
            return place
        body = bodies[i]
        return data.xpos[body] + data.xmat[body].reshape(3, 3) @ place


def _add(
    scene: mujoco.MjvScene,
    place: FloatArray,
    tip: FloatArray | None,
    radius: float,
    colour: Sequence[float],
) -> None:
    """Add an arrow between two places (3,), or a sphere at one."""
    geom, scene.ngeom = scene.geoms[scene.ngeom], scene.ngeom + 1
    kind = mujoco.mjtGeom.mjGEOM_SPHERE if tip is None else mujoco.mjtGeom.mjGEOM_ARROW
    sizes, rotation = np.full(3, radius), np.eye(3).ravel()
    mujoco.mjv_initGeom(
        geom, kind, sizes, np.asarray(place, float), rotation, np.array(colour, np.float32)
    )
    if tip is not None:
        mujoco.mjv_connector(geom, kind, radius, np.asarray(place, float), np.asarray(tip, float))
        geom.size[2] *= 2.0  # MuJoCo draws an arrow half as long as its size
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR


def glow(share: float, colour: tuple[int, int, int]) -> list[float]:
    """RGBA of a painted geometry, in [0, 1]: white at share 0, its colour from 1 on; any share
    above 0 is visible.
    """
    mix = 0.45 + 0.55 * min(share, 1.0) if share > 0 else 0.0
    return [*((1.0 - mix) * 0.95 + mix * value / 255 for value in colour), 1.0]
