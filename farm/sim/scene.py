"""A compiled MuJoCo model, and the parts of it that are drawn."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np

from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.sim import paint

MODEL: Final = "model"
"""Name of the channel that says which of several models a rollout has, by flags."""

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


@dataclass(frozen=True)
class Geometry:
    """One primitive or mesh to draw, fixed to a body.

    Sizes are MuJoCo's: sphere (r), capsule and cylinder (r, half length along z), box and ellipsoid
    (half sizes), plane (half sizes along x and y, 0 for endless), mesh (half sizes of the box
    around it) [m].
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
    """Vertices of a mesh, before it is turned and placed [m], (V, 3)."""
    faces: IntArray | None = None
    """Triangles of the mesh, rows of `vertices`, (F, 3)."""
    models: tuple[int, ...] = ()
    """Which of several models have it; empty: all."""
    grid: float = 0.0
    """Distance between the lines on a floor [m]; 0: it has none."""

    def same(self, other: "Geometry") -> bool:
        """Whether another model's geometry looks the same."""
        arrays = ((self.vertices, other.vertices), (self.faces, other.faces))
        bare = [replace(each, vertices=None, faces=None, models=()) for each in (self, other)]
        return bare[0] == bare[1] and all(np.array_equal(one, another) for one, another in arrays)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Mover:
    """The moving part of a scene, in the pose in which it is framed."""

    centre: tuple[float, float, float]
    """Middle of the box around all that moves [m]."""
    radius: float
    """Half the box's diagonal [m]."""
    body: str
    """First body that moves: the others are mostly attached to it."""
    index: int
    """Number of this body in the model."""
    place: tuple[float, float, float]
    """Where this body is [m]."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled model, and its drawn parts."""

    model: mujoco.MjModel
    start: FloatArray | None = None
    """Positions (nq,) in which its moving part is framed; None: the model's own."""
    mocap: FloatArray | None = None
    """Poses of mocap bodies there, (nmocap, 7); None: the model's own."""
    others: "tuple[Scene, ...]" = ()
    """Scenes of further models, of which a rollout has one; their bodies are the same."""

    @classmethod
    def of(cls, models: Sequence[mujoco.MjModel]) -> "Scene":
        """The scene of a task's models, at least one."""
        return cls(models[0], others=tuple(map(cls, models[1:])))

    @property
    def each(self) -> "tuple[Scene, ...]":
        """Itself and the others, in the order of the models."""
        return (self, *self.others)

    def said(self, which: int, frames: int) -> dict[str, FloatArray]:
        """Values of the channel MODEL, which says which model a rollout of this number of frames
        has; nothing if there is only one model.
        """
        return {MODEL: np.tile(np.eye(len(self.each))[which], (frames, 1))} if self.others else {}

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """Names of every body that is drawn, in the model's order: all that have a geometry."""
        names = {i: self.model.body(i).name for i in self._drawn}
        nameless = [i for i, name in names.items() if not name]
        substitutes = distinct([f"body_{i}" for i in nameless], set(names.values()))
        return tuple((names | dict(zip(nameless, substitutes, strict=True))).values())

    @cached_property
    def fixed(self) -> frozenset[str]:
        """Names of the drawn bodies that never move."""
        moving = self._moving[self._drawn]
        return frozenset(name for name, moves in zip(self.bodies, moving, strict=True) if not moves)

    @cached_property
    def mover(self) -> Mover | None:
        """The moving bodies; None if nothing moves."""
        model, data = self.model, mujoco.MjData(self.model)
        place(data, model.qpos0 if self.start is None else self.start, self.mocap)
        mujoco.mj_kinematics(model, data)
        geoms = np.flatnonzero(self._moving[model.geom_bodyid])
        if not len(geoms):
            return None
        centres, reach = data.geom_xpos[geoms], model.geom_rbound[geoms, None]
        least, most = (centres - reach).min(axis=0), (centres + reach).max(axis=0)
        bodies = model.geom_bodyid[geoms]
        # A goal is seen, but a robot is followed
        jointed = bodies[model.body_mocapid[model.body_rootid[bodies]] < 0]
        first = int((jointed if len(jointed) else bodies)[0])
        return Mover(
            centre=tuple((0.5 * (least + most)).tolist()),
            radius=0.5 * float(np.linalg.norm(most - least)),
            body=self.bodies[self._drawn.index(first)],
            index=first,
            place=tuple(data.xpos[first].tolist()),
        )

    @property
    def radius(self) -> float:
        """Radius of the moving part, or of the whole scene if nothing moves [m]."""
        return float(self.model.stat.extent) if self.mover is None else self.mover.radius

    @property
    def grid(self) -> float:
        """Distance between the lines on a floor [m]."""
        return paint.spacing(self.radius)

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
        """Index among `bodies` of the body with this name in the model; a ConfigError if it has
        no geometry.
        """
        if body not in self.bodies:
            raise ConfigError(
                f"no body {body!r} with a geometry in the model; known are {', '.join(self.bodies)}"
            )
        return self.bodies.index(body)

    def number(self, body: str) -> int:
        """Number in the model of the body with this name; a ConfigError if it has no geometry."""
        return self._drawn[self.index(body)]

    def poses(self, qpos: FloatArray, mocap: FloatArray | None = None) -> FloatArray:
        """Poses of the drawn bodies.

        Args:
          qpos: (F, nq) positions, one row per frame.
          mocap: (F, nmocap, 7) poses of the mocap bodies; None: the model's own.

        Returns:
          (F, B, 7): position [m] and quaternion wxyz of each of `bodies`, in the world.
        """
        data = mujoco.MjData(self.model)
        out = np.empty((len(qpos), len(self._drawn), 7))
        for at, (frame, row) in enumerate(zip(out, qpos, strict=True)):
            place(data, row, None if mocap is None else mocap[at])
            mujoco.mj_kinematics(self.model, data)
            frame[:, :3], frame[:, 3:] = data.xpos[self._drawn], data.xquat[self._drawn]
        return out

    def geometries(self) -> list[Geometry]:
        """Everything to draw: primitives and meshes of the groups that MuJoCo's viewers show, of
        all models.
        """
        shapes: list[tuple[Geometry, list[int]]] = []
        for index, scene in enumerate(self.each):
            for geometry in scene._own(self.grid):
                owners = next((models for other, models in shapes if other.same(geometry)), None)
                if owners is None:
                    shapes.append((geometry, [index]))
                else:
                    owners.append(index)
        return [
            geometry
            if len(set(models)) == len(self.each)
            else replace(geometry, name=f"{geometry.name}-{models[0]}", models=tuple(models))
            for geometry, models in shapes
        ]

    def _own(self, grid: float) -> list[Geometry]:
        """Geometries of this model, with a grid of this spacing [m] on a floor."""
        bodies = dict(zip(self._drawn, self.bodies, strict=True))
        floors = paint.floors(self.model)
        colours = paint.colours(self.model)
        model = self.model
        drawable = [i for i in range(model.ngeom) if int(model.geom_type[i]) in _SHAPES]
        ids = [
            i for i in drawable if model.geom_group[i] < _GROUPS
        ] or drawable  # draw the hidden ones rather than nothing
        geoms = [model.geom(i) for i in ids]
        return [
            Geometry(
                name=geom.name or f"geom_{geom.id}",
                body=bodies[int(geom.bodyid[0])],
                shape=_SHAPES[mujoco.mjtGeom(int(geom.type[0]))],
                size=tuple(geom.size.tolist()),
                position=tuple(geom.pos.tolist()),
                quaternion=tuple(geom.quat.tolist()),
                colour=tuple(self._colour(geom.id, colours).tolist()),
                grid=grid if geom.id in floors else 0.0,
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
            "vertices": model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[mesh])].astype(
                float
            ),
            "faces": model.mesh_face[face : face + int(model.mesh_facenum[mesh])].astype(int),
        }

    def _colour(self, i: int, colours: FloatArray) -> FloatArray:
        """A geometry's colour, of `colours` (ngeom, 4), or its material's, as in MuJoCo's renderer
        (4,).
        """
        material = int(self.model.geom_matid[i])
        painted = not np.allclose(self.model.geom_rgba[i], paint.UNPAINTED)
        if material < 0 or painted or (self.model.mat_texid[material] >= 0).any():
            return colours[i]
        return self.model.mat_rgba[material]

    @cached_property
    def _drawn(self) -> list[int]:
        return sorted(set(self.model.geom_bodyid.tolist()))

    @property
    def _moving(self) -> BoolArray:
        """Whether each body of the model can move, by joints or as a mocap body, (nbody,)."""
        return np.asarray(self.model.body_weldid != 0)


def place(data: mujoco.MjData, qpos: FloatArray, mocap: FloatArray | None) -> None:
    """Set positions (nq,), and poses of mocap bodies (nmocap, 7); None: as they are."""
    data.qpos[:] = qpos
    if mocap is not None:
        data.mocap_pos[:], data.mocap_quat[:] = mocap[:, :3], mocap[:, 3:]


def quiet() -> None:
    """Keep MuJoCo's warnings from the terminal and from a MUJOCO_LOG.TXT in the user's folder.

    A rollout whose simulation becomes unstable is reported as failed; MuJoCo's setting is
    process-wide.
    """
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    mujoco.MjLogConfig.set(config)


def distinct(names: Sequence[str], others: Set[str]) -> list[str]:
    """Names of which no two are equal, and none is among others: those that are get a _, or
    several, behind them.
    """
    out: list[str] = []
    before, all_names = set(others), set(names)
    for name in names:
        new = name
        while new in before or (new != name and new in all_names):
            new += "_"
        out.append(new)
        before.add(new)
    return out
