"""Assets to a compiled MuJoCo model with named indices, and what there is to draw; a door to mujoco."""

import re
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError

STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""What a simulator state holds: everything that the next step depends on, as mujoco.batch keeps it."""

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


def compiled(mjcf: str, name: str) -> mujoco.MjModel:
    """The model of an MJCF text that needs no other file.

    Raises:
      ConfigError: MuJoCo refuses it; names it.
    """
    try:
        model = mujoco.MjModel.from_xml_string(mjcf)
    except ValueError as error:
        raise ConfigError(f"{name}: MuJoCo refuses its model: {' '.join(str(error).split())[:300]}") from None
    # A state that has blown up stays visible, so that its rollout is reported as failed.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model
