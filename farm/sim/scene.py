"""A compiled MuJoCo model, and the parts of it that are drawn."""

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import ConfigError, brief

BESIDE: Final = (106.0, -25.0)
"""Azimuth and elevation from which a scene without a camera of its own is seen [deg]: most robots walk along x."""

AWAY: Final = 3.5
"""Distance from which it is seen, in radii of the moving part."""

_SHAPES: Final = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
_GROUPS: Final = 3  # MuJoCo's viewers hide the groups from this one on: mostly collision geometries
_UNPAINTED: Final = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geometry


@dataclass(frozen=True)
class Geometry:
    """One primitive or mesh to draw, fixed to a body.

    Sizes are MuJoCo's: sphere (r), capsule and cylinder (r, half length along z), box and ellipsoid (half sizes),
    plane (half sizes along x and y, 0 for endless), mesh (half sizes of the box around it) [m].
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
    vertices: FloatArray | None = None
    """Of a mesh, before it is turned and placed [m], (V, 3)."""
    faces: IntArray | None = None
    """Its triangles, rows of `vertices`, (F, 3)."""


@dataclass(frozen=True)
class Mover:
    """The moving part of a scene, in the model's initial pose."""

    centre: tuple[float, float, float]
    """Middle of the box around all that moves [m]."""
    radius: float
    """Half the box's diagonal [m]."""
    body: str
    """Its first body: the others are mostly attached to it."""


@dataclass(frozen=True)
class Scene:
    """A compiled model, and its drawn parts."""

    model: mujoco.MjModel

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Names of every body that is drawn, in the model's order: all that have a geometry."""
        return tuple(_name(self.model.body(i).name, f"body_{i}") for i in self._drawn)

    @cached_property
    def fixed(self) -> frozenset[str]:
        """Names of the drawn bodies that never move."""
        moving = self._moving[self._drawn]
        return frozenset(name for name, moves in zip(self.bodies, moving, strict=True) if not moves)

    @cached_property
    def mover(self) -> Mover | None:
        """The moving bodies; None if nothing moves."""
        model, data = self.model, mujoco.MjData(self.model)
        mujoco.mj_kinematics(model, data)
        geoms = np.flatnonzero(self._moving[model.geom_bodyid])
        if not len(geoms):
            return None
        centres, reach = data.geom_xpos[geoms], model.geom_rbound[geoms, None]
        least, most = (centres - reach).min(axis=0), (centres + reach).max(axis=0)
        first = self.bodies[self._drawn.index(model.geom_bodyid[geoms[0]])]
        x, y, z = (0.5 * (least + most)).tolist()
        return Mover((x, y, z), 0.5 * float(np.linalg.norm(most - least)), first)

    @property
    def radius(self) -> float:
        """Radius of the moving part, or of the whole scene if nothing moves [m]."""
        return float(self.model.stat.extent) if self.mover is None else self.mover.radius

    @cached_property
    def free(self) -> str | None:
        """The first drawn body without a parent, such as an object; None if there is none."""
        joints = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        bodies = [int(body) for body in self.model.jnt_bodyid[joints] if body in self._drawn]
        return self.bodies[self._drawn.index(bodies[0])] if bodies else None

    @property
    def left_out(self) -> int:
        """Number of geometries that cannot be drawn: height fields and signed distance fields."""
        return sum(int(kind) not in _SHAPES for kind in self.model.geom_type)

    def index(self, body: str) -> int:
        """Index among `bodies` of the body with this name in the model; a ConfigError if it has no geometry."""
        name = _name(body, body)
        if name not in self.bodies:
            raise ConfigError(f"no body {body!r} with a geometry in the model; known are {', '.join(self.bodies)}")
        return self.bodies.index(name)

    def poses(self, qpos: FloatArray) -> FloatArray:
        """Poses of the drawn bodies.

        Args:
          qpos: (F, nq) positions, one row per frame.

        Returns:
          (F, B, 7): position [m] and quaternion wxyz of each of `bodies`, in the world.
        """
        data = mujoco.MjData(self.model)
        out = np.empty((len(qpos), len(self._drawn), 7))
        for frame, row in zip(out, qpos, strict=True):
            data.qpos[:] = row
            mujoco.mj_kinematics(self.model, data)
            frame[:, :3], frame[:, 3:] = data.xpos[self._drawn], data.xquat[self._drawn]
        return out

    def geometries(self) -> list[Geometry]:
        """Everything to draw: primitives and meshes of the groups that MuJoCo's viewers show."""
        bodies = dict(zip(self._drawn, self.bodies, strict=True))
        model = self.model
        known = [i for i in range(model.ngeom) if int(model.geom_type[i]) in _SHAPES]
        shown = [i for i in known if model.geom_group[i] < _GROUPS] or known  # draw the hidden ones rather than nothing
        geoms = [model.geom(i) for i in shown]
        return [
            Geometry(
                name=_name(geom.name, f"geom_{geom.id}"),
                body=bodies[int(geom.bodyid[0])],
                shape=_SHAPES[mujoco.mjtGeom(int(geom.type[0]))],
                size=tuple(geom.size.tolist()),
                position=tuple(geom.pos.tolist()),
                quaternion=tuple(geom.quat.tolist()),
                colour=tuple(self._colour(geom.id).tolist()),
                **self._mesh(geom.id),
            )
            for geom in geoms
        ]

    def _mesh(self, i: int) -> dict[str, Any]:
        """A geometry's vertices and faces, if it is a mesh."""
        model, mesh = self.model, int(self.model.geom_dataid[i])
        if model.geom_type[i] != mujoco.mjtGeom.mjGEOM_MESH:
            return {}
        vertex, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
        return {
            "vertices": model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])].astype(float),
            "faces": model.mesh_face[face : face + int(model.mesh_facenum[mesh])].astype(int),
        }

    def _colour(self, i: int) -> FloatArray:
        """A geometry's own colour, or its material's, as in MuJoCo's renderer (4,)."""
        own, material = self.model.geom_rgba[i], int(self.model.geom_matid[i])
        if material < 0 or not np.allclose(own, _UNPAINTED) or (self.model.mat_texid[material] >= 0).any():
            return own
        return self.model.mat_rgba[material]

    @cached_property
    def _drawn(self) -> list[int]:
        return sorted(set(self.model.geom_bodyid.tolist()))

    @property
    def _moving(self) -> BoolArray:
        """Whether each body of the model can move, by joints or as a mocap body, (nbody,)."""
        return np.asarray(self.model.body_weldid != 0)


def compiled(mjcf: str, name: str) -> mujoco.MjModel:
    """Compile an MJCF text that needs no other file.

    Raises:
      ConfigError: MuJoCo refuses it; `name` names the model in the message.
    """
    try:
        model = mujoco.MjModel.from_xml_string(mjcf)
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"{name}: MuJoCo refuses the model: {brief(str(error))}") from None
    # An unstable state is not reset, so that its rollout is reported as failed.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def quiet() -> None:
    """Keep MuJoCo's warnings from the terminal and from a MUJOCO_LOG.TXT in the user's folder.

    A rollout whose simulation becomes unstable is reported as failed; MuJoCo's setting is process-wide.
    """
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    mujoco.MjLogConfig.set(config)


def _name(given: str, fallback: str) -> str:
    """A name that can be part of a path; models may use any name, or none."""
    return re.sub(r"[^\w.-]", "_", given, flags=re.ASCII) or fallback
