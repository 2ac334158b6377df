"""Pictures of a rollout by MuJoCo's own renderer, without a window.

Without a display, MUJOCO_GL (osmesa or egl) has to be set before MuJoCo is imported.
"""

import copy
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.errors import RunError
from farm.sim import paint
from farm.sim.channels import Camera, Channel
from farm.sim.framing import View
from farm.sim.marks import Marks, glow
from farm.sim.scene import Scene, place

Picture = np.ndarray[Any, np.dtype[np.uint8]]

BACKGROUND: Final = (0.94, 0.95, 0.96)
"""Red, green, blue in [0, 1]."""

_AMBIENT: Final = (0.45, 0.45, 0.45)
_DIFFUSE: Final = (0.55, 0.55, 0.55)
# Where fog begins and is complete, in distances from the camera to its target
_FOG: Final = (3.0, 6.0)
_WALL: Final = 7.0  # distance of the background's wall: in complete fog
_PAINT: Final = (213, 94, 0)  # for channels without colours
_SHINE: Final = 0.35  # of a floor without a colour of its own
_NEAR: Final = 8  # lines to each side of where the camera looks
_RAISED: Final = 0.002  # how far its lines are above it, in spacings
_SMOOTH: Final = 2  # factor of the size drawn, for smooth edges


def pictures(
    model: mujoco.MjModel,
    qpos: FloatArray,
    size: tuple[int, int],
    *,
    camera: Camera | None,
    mocap: FloatArray | None = None,
    channels: Sequence[Channel] = (),
    values: Mapping[str, FloatArray] | None = None,
) -> Iterator[Picture]:
    """Draw states of a rollout.

    Args:
      model: of the physics; it is not changed.
      qpos: (F, nq) positions; the first is the start.
      size: width and height [pixels].
      camera: point of view; None: from beside what moves, all of which is in view.
      mocap: (F, nmocap, 7) poses of the mocap bodies; None: the model's own.
      channels: of the task: arrows and points are drawn, geometries that scalars name in `geoms`
          painted.
      values: of these channels, by name, (F, ...).

    Yields:
      (height, width, 3), one per state.

    Raises:
      RunError: MuJoCo cannot draw on this machine.
    """
    first = None if mocap is None else mocap[0]
    poses = [Scene(model, qpos[0], first).poses(qpos, mocap)]
    with Painter(
        model, qpos[0], size, camera=camera, mocap=first, poses=poses, channels=channels
    ) as painter:
        for frame, row in enumerate(qpos):
            current = {name: each[frame] for name, each in (values or {}).items()}
            yield painter.picture(row, None if mocap is None else mocap[frame], current)


class Painter:
    """Draws states of a model one after another, as they come."""

    def __init__(
        self,
        model: mujoco.MjModel,
        start: FloatArray,
        size: tuple[int, int],
        *,
        camera: Camera | None,
        mocap: FloatArray | None = None,
        poses: Sequence[FloatArray] = (),
        channels: Sequence[Channel] = (),
    ) -> None:
        """Set up light and point of view.

        Args:
          model: of the physics; it is not changed.
          start: (nq,) positions in which the scene is framed.
          size: width and height [pixels].
          camera: point of view; None: from beside what moves.
          mocap: (nmocap, 7) poses of the mocap bodies at the start; None: the model's own.
          poses: of the bodies in what will be shown, (F, B, 7) each, all of which is then in view.
          channels: of the task, drawn where their values are given.

        Raises:
          RunError: MuJoCo cannot draw on this machine.
        """
        scene = Scene(model, start, mocap)
        self._view = View(scene, camera, poses)
        self._marks = Marks(scene, channels)
        self._painted = [
            channel for channel in channels if channel.kind == "scalars" and channel.geoms
        ]
        self._model = lit(model, self._view.camera.distance, size)
        self._floors = paint.floors(model)
        self._grid = scene.grid
        self._free = aimed(mujoco.MjvCamera(), self._view.camera)
        self._data = mujoco.MjData(self._model)
        self._renderer = _renderer(self._model, size)

    def picture(
        self, qpos: FloatArray, mocap: FloatArray | None, values: Mapping[str, FloatArray]
    ) -> Picture:
        """A state (nq,) with values of the channels by name, if there are any: (height, width,
        3).
        """
        for channel in self._painted if values else ():
            _paint(self._model, channel, values[channel.name])
        place(self._data, qpos, mocap)
        mujoco.mj_forward(self._model, self._data)
        if self._view.mover is not None:
            self._free.lookat += self._view.moved(self._data.xpos[self._view.mover.index])
        self._renderer.update_scene(self._data, self._free)
        if values:
            self._marks.put(self._renderer.scene, self._data, values)
        for floor in self._floors:
            _lines(self._renderer.scene, self._data, floor, self._grid, self._free.lookat)
        _backdrop(self._renderer.scene, self._model)
        return _halved(self._renderer.render())

    def __enter__(self) -> "Painter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def lit(
    model: mujoco.MjModel, distance: float = 1.0, size: tuple[int, int] = (0, 0)
) -> mujoco.MjModel:
    """A copy of a model with bright light, fog of the background's colour, and colours for what has
    none.

    Its physics is the same.

    For a camera at that distance from its target [m], and pictures of that size [pixels].
    """
    model = copy.copy(model)
    model.geom_rgba[:] = paint.colours(model)
    look = model.vis
    look.global_.offwidth = max(look.global_.offwidth, size[0] * _SMOOTH)
    look.global_.offheight = max(look.global_.offheight, size[1] * _SMOOTH)
    look.quality.offsamples, look.quality.shadowsize = 0, 1024
    look.headlight.ambient[:], look.headlight.diffuse[:] = _AMBIENT, _DIFFUSE
    look.rgba.fog[:3] = BACKGROUND
    far = distance / model.stat.extent
    look.map.fogstart, look.map.fogend = (part * far for part in _FOG)
    look.map.zfar = max(look.map.zfar, 2 * _WALL * far)
    return model


def check_drawing() -> None:
    """Draw nothing, to see whether MuJoCo can draw here; raises RunError if it cannot."""
    _renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), (8, 8)).close()


def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> mujoco.Renderer:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns before it fails
            return mujoco.Renderer(model, size[1] * _SMOOTH, size[0] * _SMOOTH)
    except Exception as error:  # each backend fails in its own way
        why = " ".join(str(error).split())[:60]
        raise RunError(
            f"MuJoCo cannot draw here ({type(error).__name__}: {why} ...): without a display,"
            " install libosmesa6 or libegl1, or choose one by MUJOCO_GL=osmesa or egl"
        ) from None


def aimed(view: mujoco.MjvCamera, camera: Camera) -> mujoco.MjvCamera:
    """MuJoCo's free camera, looking from this point of view."""
    view.lookat[:] = camera.lookat
    view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
    return view


def _lines(
    scene: mujoco.MjvScene, data: mujoco.MjData, floor: int, step: float, about: FloatArray
) -> None:
    """Draw a grid on a floor around a place (3,) [m]; the floor shines itself, as a light from the
    side would leave it dark.
    """
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid == floor:
            geom.emission, geom.specular = _SHINE, 0.0
    middle = data.geom_xpos[floor]
    turned = data.geom_xmat[floor].reshape(3, 3)
    thick = paint.WIDTH * step
    colour = np.array(paint.LINE, np.float32)
    near = ((about - middle) @ turned)[:2]
    for ends in paint.grid(np.array(data.model.geom_size[floor, :2]), step, near, _NEAR):
        if scene.ngeom >= scene.maxgeom:
            return
        geom, scene.ngeom = scene.geoms[scene.ngeom], scene.ngeom + 1
        half = 0.5 * np.abs(ends[1] - ends[0]) + 0.5 * thick
        place = middle + turned @ np.array([*ends.mean(axis=0), 0.0])
        sides = np.array([*half, _RAISED * step])
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_BOX, sides, place, turned.ravel(), colour)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # these cast no shadow


def _backdrop(scene: mujoco.MjvScene, model: mujoco.MjModel) -> None:
    """Put a wall in complete fog behind the scene: a compiled model takes no new sky, and without a
    sky it is black.
    """
    # A floor would mirror the wall
    for flag, on in (("FOG", 1), ("SKYBOX", 0), ("HAZE", 0), ("REFLECTION", 0)):
        scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = on
    view = scene.camera[0]
    ahead, up = np.array(view.forward), np.array(view.up)
    away = 0.5 * model.vis.map.zfar * model.stat.extent
    turned = np.stack([np.cross(ahead, up), up, -ahead], axis=1)
    wall, scene.ngeom = scene.geoms[scene.ngeom], scene.ngeom + 1
    sides, colour = [2 * away, 2 * away, 0.01 * away], np.array([*BACKGROUND, 1.0], np.float32)
    mujoco.mjv_initGeom(
        wall,
        mujoco.mjtGeom.mjGEOM_BOX,
        sides,
        np.array(view.pos) + away * ahead,
        turned.ravel(),
        colour,
    )
    wall.category = mujoco.mjtCatBit.mjCAT_DECOR  # these cast no shadow


def _paint(model: mujoco.MjModel, channel: Channel, values: FloatArray) -> None:
    """Colour the channel's geometries by its values (n,)."""
    colours = channel.colours or [_PAINT] * len(channel.geoms)
    for geom, value, colour in zip(channel.geoms, values.tolist(), colours, strict=True):
        index = model.geom(geom).id
        model.geom_matid[index] = -1
        model.geom_rgba[index] = glow(value / channel.top, colour)


def _halved(picture: Picture) -> Picture:
    """Reduce a picture to its size: each pixel is the mean of those drawn for it."""
    total = sum(
        picture[row::_SMOOTH, column::_SMOOTH].astype(np.uint16)
        for row in range(_SMOOTH)
        for column in range(_SMOOTH)
    )
    return np.asarray(total // _SMOOTH**2, dtype=np.uint8)
