"""Assets to a compiled MuJoCo model with named indices; one of the two doors to mujoco."""

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

import assets
from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.hand import FINGERS, JOINTS

CONTACTS: Final = 4
"""Contacts kept a fingertip (the strongest); a sphere on a convex body has one."""

CONTACT_WIDTH: Final = 7
"""Numbers a contact: found (1), force in the contact frame (3) [N], position in the world (3) [m]."""

OBJECT: Final = "object"
_SHAPES: Final = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}


@dataclass(frozen=True)
class Geometry:
    """One primitive to draw, fixed to a body.

    Sizes are MuJoCo's: sphere (r), capsule and cylinder (r, half length along z), box (half sizes) [m].
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
    """A compiled hand with one object, and where things are in its arrays.

    The object hangs on a weld to the mocap body `anchor` while equality 0 is active: that is
    the task's freeze. Its free joint comes last in `qpos`, after the eight controlled joints.
    """

    model: mujoco.MjModel
    object_name: str

    @property
    def object_qpos(self) -> slice:
        """Where the object's pose, position and quaternion wxyz, stands in qpos."""
        return slice(len(JOINTS), len(JOINTS) + 7)

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

    @property
    def object_geoms(self) -> list[int]:
        """The geometries of the object."""
        return np.flatnonzero(self.model.geom_bodyid == self.object_body).tolist()

    @property
    def bodies(self) -> tuple[str, ...]:
        """Every body that is drawn, in the model's order, world and anchor left out."""
        drawn = set(self.model.geom_bodyid.tolist())
        return tuple(self.model.body(i).name for i in sorted(drawn))

    def poses(self, qpos: FloatArray) -> FloatArray:
        """Where the drawn bodies are.

        Args:
          qpos: (F, nq) positions, one row a frame.

        Returns:
          (F, B, 7): position [m] and quaternion wxyz of each of `bodies`, in the world.
        """
        data = mujoco.MjData(self.model)
        ids = [self.model.body(name).id for name in self.bodies]
        out = np.empty((len(qpos), len(ids), 7))
        for frame, row in zip(out, qpos, strict=True):
            data.qpos[:] = row
            mujoco.mj_kinematics(self.model, data)
            frame[:, :3], frame[:, 3:] = data.xpos[ids], data.xquat[ids]
        return out

    def geometries(self) -> list[Geometry]:
        """Everything there is to draw."""
        out = []
        for i in range(self.model.ngeom):
            geom = self.model.geom(i)
            out.append(
                Geometry(
                    name=geom.name,
                    body=self.model.body(geom.bodyid[0]).name,
                    shape=_SHAPES[mujoco.mjtGeom(geom.type[0])],
                    size=tuple(geom.size.tolist()),
                    position=tuple(geom.pos.tolist()),
                    quaternion=tuple(geom.quat.tolist()),
                    colour=tuple(geom.rgba.tolist()),
                )
            )
        return out


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


def load(object_name: str) -> Scene:
    """Compile the hand with the object of that name.

    Raises:
      ConfigError: there is no such object.
    """
    known = assets.objects()
    if object_name not in known:
        raise ConfigError(f"unknown object {object_name!r}; known are {', '.join(known)}")
    parts = {name: assets.path(name).read_bytes() for name in ("hand.xml", "finger_gait.xml")}
    parts["object.xml"] = assets.path(f"objects/{object_name}.xml").read_bytes()
    includes = "".join(f'<include file="{name}"/>' for name in parts)
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{includes}</mujoco>", assets=parts)
    return Scene(model=model, object_name=object_name)
