"""Primitives and meshes of a MuJoCo model as Rerun archetypes, and turning by quaternions."""

from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray, IntArray
from farm.sim import paint
from farm.sim.scene import Geometry

ENDLESS: Final = 50.0
"""Half a side of a plane without end, as it is drawn [m]."""

_THIN: Final = 0.001  # [m]


def solid(geometry: Geometry) -> Any:  # noqa: ANN401  (archetypes without a common base)
    """A MuJoCo primitive or mesh as a Rerun one, in its body's frame."""
    quaternion = np.array(geometry.quaternion)
    style = {
        "quaternions": [xyzw(quaternion)],
        "colors": [[round(255 * part) for part in geometry.colour]],
        "fill_mode": rr.components.FillMode.Solid,
    }
    centre, size = np.array(geometry.position), geometry.size
    if geometry.vertices is not None and geometry.faces is not None:
        return _mesh(
            rotate(quaternion, geometry.vertices) + centre, geometry.faces, style["colors"][0]
        )
    if geometry.shape == "box":
        return rr.Boxes3D(half_sizes=[size[:3]], centers=[centre], **style)
    if geometry.shape == "plane":  # Rerun has none: a thin box below it
        sides = [side or ENDLESS for side in size[:2]]
        below = centre - rotate(quaternion, np.array([0.0, 0.0, _THIN]))
        return rr.Boxes3D(half_sizes=[[*sides, _THIN]], centers=[below], **style)
    if geometry.shape in ("sphere", "ellipsoid"):
        half_sizes = [size if geometry.shape == "ellipsoid" else size[:1] * 3]
        return rr.Ellipsoids3D(half_sizes=half_sizes, centers=[centre], **style)
    if geometry.shape == "cylinder":
        return rr.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], centers=[centre], **style)
    # MuJoCo's capsule is centred, Rerun's starts where its axis begins.
    start = centre - rotate(quaternion, np.array([0.0, 0.0, size[1]]))
    return rr.Capsules3D(radii=[size[0]], lengths=[2 * size[1]], translations=[start], **style)


def grid(geometry: Geometry) -> rr.LineStrips3D:
    """The lines on a floor, in its body's frame."""
    step = geometry.grid
    flat = paint.grid(np.array([side or ENDLESS for side in geometry.size[:2]]), step)
    above = np.full((*flat.shape[:2], 1), 0.5 * paint.WIDTH * step)
    turned = rotate(np.array(geometry.quaternion), np.concatenate([flat, above], axis=2))
    return rr.LineStrips3D(
        list(turned + np.array(geometry.position)),
        colors=[[round(255 * part) for part in paint.LINE]],
        radii=0.5 * paint.WIDTH * step,
    )


def _mesh(vertices: FloatArray, faces: IntArray, colour: list[int]) -> rr.Mesh3D:
    """Triangles between vertices (V, 3); a vertex' normal is the mean of its faces', by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, across[:, None])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=faces,
        vertex_normals=normals / np.where(length > 0, length, 1.0),
        albedo_factor=colour,
    )


def rotate(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Turn vectors (..., 3) by unit quaternions wxyz (..., 4): v + 2 w (u x v) + 2 u x (u x v)."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    cross = np.cross(axis, vector)
    return np.asarray(vector + 2.0 * (scalar * cross + np.cross(axis, cross)))


def xyzw(quaternion: FloatArray) -> FloatArray:
    """Quaternions wxyz in Rerun's order (..., 4)."""
    return np.roll(quaternion, -1, axis=-1)
