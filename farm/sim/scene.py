"""Assets to a compiled MuJoCo model with named indices, and what there is to draw; a door to mujoco."""

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

import assets
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.tasks.finger_gait.hand import FINGERS
from farm.tasks.finger_gait.task import Frames

CONTACTS: Final = 4
"""Contacts kept a fingertip (the strongest); a sphere on a convex body has one."""

CONTACT_WIDTH: Final = 7
"""Numbers a contact: found (1), force in the contact frame (3) [N], position in the world (3) [m]."""

STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""What a simulator state holds: everything that the next step depends on, as mujoco.batch keeps it."""

OBJECT: Final = "object"
_SHAPES: Final = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
}


@dataclass(frozen=True)
class Geometry:
    """One primitive to draw, fixed to a body.

    Sizes are MuJoCo's: sphere (r), capsule and cylinder (r, half length along z), box and ellipsoid (half sizes),
    plane (half sizes along x and y, 0 for endless) [m].
    """

    name: str
    body: str
    shape: str
    size: tuple[float, ...]
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    """Orientation in the body, wxyz."""
    colour: tuple[float, ...]
    """RGBA in [0, 1]."""


@dataclass(frozen=True)
class Scene:
    """A compiled model, and what of it is drawn."""

    model: mujoco.MjModel

    @property
    def bodies(self) -> tuple[str, ...]:
        """Every body that is drawn, in the model's order: all that have a geometry."""
        return tuple(_name(self.model.body(i).name, f"body_{i}") for i in self._drawn)

    @property
    def fixed(self) -> frozenset[str]:
        """The drawn bodies that never move."""
        return frozenset(n for n, i in zip(self.bodies, self._drawn, strict=True) if self.model.body_weldid[i] == 0)

    @property
    def _drawn(self) -> list[int]:
        return sorted(set(self.model.geom_bodyid.tolist()))

    def poses(self, qpos: FloatArray) -> FloatArray:
        """Where the drawn bodies are.

        Args:
          qpos: (F, nq) positions, one row a frame.

        Returns:
          (F, B, 7): position [m] and quaternion wxyz of each of `bodies`, in the world.
        """
        data = mujoco.MjData(self.model)
        ids = self._drawn
        out = np.empty((len(qpos), len(ids), 7))
        for frame, row in zip(out, qpos, strict=True):
            data.qpos[:] = row
            mujoco.mj_kinematics(self.model, data)
            frame[:, :3], frame[:, 3:] = data.xpos[ids], data.xquat[ids]
        return out

    def geometries(self) -> list[Geometry]:
        """Everything there is to draw; meshes and height fields are left out."""
        out, bodies = [], dict(zip(self._drawn, self.bodies, strict=True))
        for i in range(self.model.ngeom):
            geom, shape = self.model.geom(i), _SHAPES.get(mujoco.mjtGeom(self.model.geom_type[i]))
            if shape is None:
                continue
            out.append(
                Geometry(
                    name=_name(geom.name, f"geom_{i}"),
                    body=bodies[int(geom.bodyid[0])],
                    shape=shape,
                    size=tuple(geom.size.tolist()),
                    position=tuple(geom.pos.tolist()),
                    quaternion=tuple(geom.quat.tolist()),
                    colour=tuple(geom.rgba.tolist()),
                )
            )
        return out


@dataclass(frozen=True)
class HandScene(Scene):
    """A compiled hand with one object, and where things are in its arrays.

    The object hangs on a weld to the mocap body `anchor` while equality 0 is active: that is
    the task's freeze. Its free joint comes last in `qpos`, after the eight controlled joints.
    """

    object_name: str

    @property
    def object_body(self) -> int:
        """The object's body."""
        return int(self.model.body(OBJECT).id)

    @property
    def tip_sites(self) -> list[int]:
        """The sites at the centres of the fingertips, in the order of FINGERS."""
        return [int(self.model.site(f"{finger}_tip").id) for finger in FINGERS]

    @property
    def tip_geoms(self) -> list[int]:
        """The fingertips' spheres, in the order of FINGERS."""
        return [int(self.model.geom(f"{finger}_tip").id) for finger in FINGERS]

    def measure(self, data: mujoco.MjData) -> Frames:
        """What the sensors of a simulation say now, (1,)."""
        sensors = data.sensordata.reshape(1, len(FINGERS), CONTACTS, CONTACT_WIDTH)
        axes = data.site_xmat[self.tip_sites].reshape(1, len(FINGERS), 1, 3, 3)
        away = sensors[..., 4:7] - data.site_xpos[self.tip_sites][None, :, None, :]
        place = axes[..., 0, :] * away[..., 0:1] + axes[..., 1, :] * away[..., 1:2] + axes[..., 2, :] * away[..., 2:3]
        found = sensors[..., 0] > 0
        force = np.where(found, sensors[..., 1], 0.0)
        return Frames(qpos=data.qpos[None].copy(), force=force, place=np.where(found[..., None], place, 0.0))

    @property
    def object_geoms(self) -> list[int]:
        """The geometries of the object."""
        return np.flatnonzero(self.model.geom_bodyid == self.object_body).tolist()


def _name(given: str, fallback: str) -> str:
    """A name that can stand in a path: environments name things as they like, or not at all."""
    return re.sub(r"[^\w.-]", "_", given, flags=re.ASCII) or fallback


def quiet() -> None:
    """Keep MuJoCo's warnings from the terminal and from a MUJOCO_LOG.TXT in the user's folder.

    A rollout whose physics blows up is reported as failed; process-wide, as MuJoCo's setting is.
    """
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    mujoco.MjLogConfig.set(config)


def digest() -> str:
    """Hash of every asset: machines that differ in it simulate something else."""
    return assets.digest()


def load(object_name: str) -> HandScene:
    """Compile the hand with the object of that name.

    Raises:
      ConfigError: there is no such object.
    """
    return HandScene(model=compiled(text(object_name)), object_name=object_name)


def compiled(mjcf: str) -> mujoco.MjModel:
    """The model of an MJCF text that needs no other file."""
    return mujoco.MjModel.from_xml_string(mjcf)


def text(object_name: str) -> str:
    """The hand, what the task adds, and the object of that name as one MJCF text that needs no other file.

    Raises:
      ConfigError: there is no such object.
    """
    known = assets.objects()
    if object_name not in known:
        raise ConfigError(f"unknown object {object_name!r}; known are {', '.join(known)}")
    whole = ET.Element("mujoco")
    for name in ("hand.xml", "finger_gait.xml", f"objects/{object_name}.xml"):
        whole.extend(ET.fromstring(assets.path(name).read_bytes()))
    return ET.tostring(whole, encoding="unicode")
