"""Pictures of a hand by MuJoCo's own renderer, without a window; a door to mujoco.

Where there is no display, MUJOCO_GL (osmesa or egl) has to be set before MuJoCo is imported.
"""

import warnings
from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np

from farm.errors import RunError
from farm.sim import scene as scenes
from farm.sim.scene import HandScene
from farm.tasks.finger_gait.task import Frames

Picture = np.ndarray[Any, np.dtype[np.uint8]]

FIRM: Final = 3.0
"""Force from which a fingertip has its finger's full colour [N]."""

_LOOK: Final = """
<asset>
  <texture type="skybox" builtin="flat" rgb1="0.94 0.95 0.96" rgb2="0.94 0.95 0.96" width="64" height="64"/>
</asset>
<visual>
  <global offwidth="1600" offheight="1600"/><quality shadowsize="1024" offsamples="0"/>
  <headlight ambient="0.45 0.45 0.45" diffuse="0.55 0.55 0.55"/>
</visual>
"""
_COLOURS: Final = ((86, 180, 233), (0, 158, 115), (204, 121, 167))  # of the fingers, as in the recording
_SMOOTH: Final = 2  # drawn so much larger, for smooth edges


def pictures(
    object_name: str, frames: Frames, size: tuple[int, int], *, distance: float = 0.34, glow: bool = True
) -> Iterator[Picture]:
    """Draw moments of a rollout.

    Args:
      object_name: what the hand holds.
      frames: (F,) moments.
      size: width and height [pixels], at most 800.
      distance: of the camera from the hand [m].
      glow: colour the fingertips by the force on them.

    Yields:
      (height, width, 3), one for each moment.

    Raises:
      RunError: nothing can be drawn here.
    """
    scene = lit(object_name)
    model, data = scene.model, mujoco.MjData(scene.model)
    with _renderer(model, size) as renderer:
        for qpos, force in zip(frames.qpos, frames.force, strict=True):
            data.qpos[:] = qpos
            if glow:
                for geom, newton, colour in zip(scene.tip_geoms, force.sum(axis=-1).tolist(), _COLOURS, strict=True):
                    model.geom_rgba[geom] = _glow(newton, colour)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, _camera(distance))
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = 0
            yield _halved(renderer.render())


def lit(object_name: str) -> HandScene:
    """The scene with that object, with a light background; its physics is the same."""
    text = scenes.text(object_name).replace("</mujoco>", f"{_LOOK}</mujoco>")
    return HandScene(mujoco.MjModel.from_xml_string(text), object_name)


def _renderer(model: mujoco.MjModel, size: tuple[int, int]) -> mujoco.Renderer:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GLFW warns, and then fails
            return mujoco.Renderer(model, size[1] * _SMOOTH, size[0] * _SMOOTH)
    except Exception as error:  # each way of drawing fails in a way of its own
        why = " ".join(str(error).split())[:60]
        raise RunError(
            f"MuJoCo cannot draw here ({type(error).__name__}: {why} ...): without a display, install libosmesa6 or "
            "libegl1, or choose one by MUJOCO_GL=osmesa or egl"
        ) from None


def _camera(distance: float) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0.035, 0.014, 0.01)
    camera.distance, camera.azimuth, camera.elevation = distance, 150.0, -14.0
    return camera


def _glow(force: float, colour: tuple[int, int, int]) -> list[float]:
    """RGBA of a fingertip, in [0, 1]: white where it touches nothing, its finger's colour from FIRM on."""
    share = 0.0 if not force else 0.45 + 0.55 * min(force / FIRM, 1.0)  # the lightest touch shows
    return [*((1.0 - share) * 0.95 + share * value / 255 for value in colour), 1.0]


def _halved(picture: Picture) -> Picture:
    """Each pixel the mean of those drawn for it."""
    height, width, _ = picture.shape
    parts = picture.reshape(height // _SMOOTH, _SMOOTH, width // _SMOOTH, _SMOOTH, 3)
    return np.asarray(parts.mean(axis=(1, 3)), dtype=np.uint8)
