"""A scene and its rollouts as Rerun entities: what never changes, and columns for what moves.

Entities hang flat below /world: /world/<body>, with its geometries and, at a finger's last link,
its taxels as children. A finger keeps its colour everywhere (palette of Okabe and Ito).

A fingertip's picture has the taxels' 6 rows and 3 columns (see `farm.tasks.finger_gait.touch`): top is towards the back
of the finger, bottom towards its pad, left the side of negative y. A trace has the fingers' taxels
below each other, row by row, and time to the right.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import AnyArray, FloatArray, IntArray
from farm.sim.scene import Geometry, HandScene, Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.hand import FINGERS, JOINTS, TIP_RADIUS
from farm.tasks.finger_gait.rewards import TERMS
from learner.recording.curves import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    YELLOW,
    Colour,
    lines,
    pack,
    ramp,
)

FINGER_COLOURS: Final[Mapping[str, Colour]] = dict(zip(FINGERS, (SKY, GREEN, PURPLE), strict=True))
TERM_COLOURS: Final = (YELLOW, BLUE, GREY, ORANGE, VERMILLION)

TOP_FORCE: Final = 2.0
"""Force on a taxel that is drawn in the brightest colour [N]."""

ARROW: Final = 0.009
"""Length of a contact's arrow [m/N]."""

LONGEST: Final = 0.075
"""Arrows are cut here: one hard blow must not fill the scene [m]."""

ENDLESS: Final = 50.0
"""Half a side of a plane without end, as it is drawn [m]."""

_THIN: Final = 0.001  # [m]
_SHADES: Final = (1.25, 0.95, 0.65)
_TAXEL_RADIUS: Final = 0.0014
_GLASS: Final = 120  # last links are see-through: taxels and arrows start where they touch, and lie inside
_PUSH: Final = (255, 255, 255)  # its finger's colour would not be seen inside the finger
_FELT: Final = ("free", "contact")


@dataclass(frozen=True)
class Columns:
    """Rows of one entity, to be sent together."""

    entity: str
    columns: rr.ComponentColumnList
    rows: IntArray | None = None
    """Which frames the rows belong to; all of them where None."""


@dataclass(frozen=True)
class Mover:
    """What moves in a scene, as it stands before anything has moved."""

    centre: tuple[float, ...]
    """Middle of all that moves [m]."""
    radius: float
    """How far it reaches from there [m]."""
    entity: str
    """The first body of it: the others hang on it, mostly."""


class Drawing:
    """How a scene is drawn."""

    def __init__(self, scene: Scene) -> None:
        self._bodies = scene.bodies
        self._geometries = scene.geometries()
        self._rest = scene.poses(scene.model.qpos0[None])[0]
        self._fixed = scene.fixed
        self.touch = isinstance(scene, HandScene)
        """Whether there are fingertips that feel."""
        self.left_out = scene.model.ngeom - len(self._geometries)
        """Geometries that are not drawn: meshes."""
        tips = {g.name: g for g in self._geometries}
        self._tips = [tips[f"{finger}_tip"] for finger in FINGERS] if self.touch else []

    def mover(self) -> Mover | None:
        """What moves, None where nothing does."""
        poses, low, high = dict(zip(self._bodies, self._rest, strict=True)), [], []
        moving = [g for g in self._geometries if g.body not in self._fixed]
        for geometry in moving:
            pose = poses[geometry.body]
            centre, reach = pose[:3] + rotate(pose[3:], np.array(geometry.position)), max(geometry.size)
            low.append(centre - reach)
            high.append(centre + reach)
        if not moving:
            return None
        least, most = np.min(low, axis=0), np.max(high, axis=0)
        middle = tuple((0.5 * (least + most)).tolist())
        return Mover(middle, 0.5 * float(np.linalg.norm(most - least)), f"/world/{moving[0].body}")

    def static(self) -> Iterator[tuple[str, Any]]:
        """Entities and archetypes that are logged once."""
        yield "/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP
        for geometry in self._geometries:
            yield f"/world/{geometry.body}/{geometry.name}", solid(geometry, self._colour(geometry))
        for name, pose in zip(self._bodies, self._rest, strict=True):
            if name in self._fixed:
                yield (
                    f"/world/{name}",
                    rr.Transform3D(translation=pose[:3], quaternion=rr.Quaternion(xyzw=_xyzw(pose[3:]))),
                )
        if not self.touch:
            yield "/reward/terms", lines(("reward",), (YELLOW,))
            return
        for finger, tip in zip(FINGERS, self._tips, strict=True):
            yield (
                _taxels(tip),
                rr.Points3D.from_fields(positions=np.array(tip.position) + tactile.positions(), radii=_TAXEL_RADIUS),
            )
            yield f"/tactile/{finger}", _image_style(tactile.SHAPE)
            yield (
                f"/contacts/state/{finger}",
                rr.StateConfiguration(values=_FELT, colors=[(52, 54, 58), FINGER_COLOURS[finger]]),
            )
        yield "/contacts/force", lines(FINGERS, FINGER_COLOURS.values())
        yield "/reward/terms", lines(TERMS, TERM_COLOURS)
        yield "/joints/position", lines(_joint_names(), _joint_colours(), width=2.5)
        yield (
            "/joints/target",
            lines([f"{n} target" for n in _joint_names()], _joint_colours(), width=0.8),
        )

    def check(self, rollout: Trajectory) -> None:
        """Whether it can be drawn.

        Raises:
          ValueError: the rollout is not one of this scene.
        """
        count = len(rollout.times)
        if rollout.bodies.shape != (count, len(self._bodies), 7):
            expected = (count, len(self._bodies), 7)
            raise ValueError(f"poses of shape {rollout.bodies.shape}, expected {expected}: another scene?")
        if self.touch != (rollout.images.shape[1:] == (len(FINGERS), tactile.TAXELS)):
            raise ValueError(f"images of shape {rollout.images.shape}: another task?")
        moving = (rollout.joints, rollout.targets, rollout.images, rollout.points, rollout.terms)
        if any(len(values) != count for values in moving):
            raise ValueError(f"arrays over {count} and {[len(values) for values in moving]} frames")

    def columns(self, rollout: Trajectory) -> Iterator[Columns]:
        """A rollout, all its frames; or several that are joined.

        Raises:
          ValueError: the rollout is not one of this scene.
        """
        self.check(rollout)
        for name, poses in zip(self._bodies, np.moveaxis(rollout.bodies, 1, 0), strict=True):
            if name not in self._fixed:
                yield Columns(
                    f"/world/{name}",
                    rr.Transform3D.columns(translation=poses[:, :3], quaternion=_xyzw(poses[:, 3:])),
                )
        yield Columns("/reward/terms", _scalars(rollout.terms))
        if not self.touch:
            yield Columns("/actions", _scalars(rollout.targets))
            return
        yield from self._touch(rollout)
        yield Columns("/joints/position", _scalars(rollout.joints))
        yield Columns("/joints/target", _scalars(rollout.targets))

    def _colour(self, geometry: Geometry) -> list[int]:
        """RGBA of 0 to 255: a fingertip's is its finger's, all else has its own."""
        if geometry in self._tips:
            return [*FINGER_COLOURS[FINGERS[self._tips.index(geometry)]], _GLASS]
        own = [round(255 * value) for value in geometry.colour]
        return [*own[:3], _GLASS] if geometry.body in {tip.body for tip in self._tips} else own

    def _touch(self, rollout: Trajectory) -> Iterator[Columns]:
        force, number = rollout.images.sum(axis=-1), np.cumsum(rollout.times == 0.0)
        yield Columns("/contacts/force", _scalars(force))
        yield Columns("/world/contacts", self._arrows(rollout, force))
        for i, (finger, tip) in enumerate(zip(FINGERS, self._tips, strict=True)):
            image = rollout.images[:, i]
            colours = rr.Points3D.columns(colors=ramp(image.reshape(-1), TOP_FORCE))
            yield Columns(_taxels(tip), colours.partition(np.full(len(image), tactile.TAXELS)))
            buffers = np.ascontiguousarray(image, dtype=np.float32).view(np.uint8)
            yield Columns(f"/tactile/{finger}", rr.DepthImage.columns(buffer=buffers))
            rows = changes(2 * number + (force[:, i] > 0))  # and where a rollout begins
            states = [_FELT[int(force[row, i] > 0)] for row in rows]
            yield Columns(f"/contacts/state/{finger}", rr.StateChange.columns(state=states), rows)

    def _arrows(self, rollout: Trajectory, force: FloatArray) -> rr.ComponentColumnList:
        """What pushes each finger that touches: from the centre of force into the finger."""
        origins, vectors = self.contacts(rollout.bodies, rollout.points, force)
        touching = force > 0
        count = int(touching.sum())
        columns = rr.Arrows3D.columns(
            origins=origins[touching],
            vectors=vectors[touching],
            colors=np.full(count, pack(_PUSH), np.uint32),
            radii=np.full(count, 0.002),
        )
        return columns.partition(touching.sum(axis=1))

    def contacts(self, bodies: FloatArray, points: FloatArray, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Contact arrows in the world.

        Args:
          bodies: (F, B, 7) poses [m], quaternions wxyz.
          points: (F, 3, 3) centres of force in the fingertips' frames [fingertip radii].
          force: (F, 3) on each fingertip [N].

        Returns:
          origins (F, 3, 3) [m] and vectors (F, 3, 3) [m]: from the object onto the finger.
        """
        poses = bodies[:, [self._bodies.index(tip.body) for tip in self._tips]]
        offset = np.array([tip.position for tip in self._tips]) + points * TIP_RADIUS
        origins = poses[..., :3] + rotate(poses[..., 3:], offset)
        length = np.linalg.norm(points, axis=-1, keepdims=True)
        inward = -points / np.where(length > 0, length, 1.0)
        extent = np.minimum(force * ARROW, LONGEST)
        return origins, rotate(poses[..., 3:], inward) * extent[..., None]


def trace(values: AnyArray) -> rr.DepthImage:
    """Taxels over a rollout, (T, 54) [N]: an image of 54 rows, finger by finger, and T columns."""
    image = np.ascontiguousarray(values.T, dtype=np.float32)
    return rr.DepthImage(
        image,
        colormap=rr.components.Colormap.Viridis,
        depth_range=(0.0, TOP_FORCE),
        magnification_filter=rr.components.MagnificationFilter.Nearest,
    )


def changes(states: AnyArray) -> IntArray:
    """The first row, and those that differ from the row before, (F,) -> (n,)."""
    return np.flatnonzero(np.append(True, states[1:] != states[:-1]))


def rotate(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Turn vectors (..., 3) by unit quaternions wxyz (..., 4): v + 2 w (u x v) + 2 u x (u x v)."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    cross = np.cross(axis, vector)
    return np.asarray(vector + 2.0 * (scalar * cross + np.cross(axis, cross)))


def solid(geometry: Geometry, colour: list[int]) -> Any:  # noqa: ANN401  (archetypes without a common base)
    """A MuJoCo primitive as a Rerun one, in its body's frame."""
    style = {
        "quaternions": [_xyzw(np.array(geometry.quaternion))],
        "colors": [colour],
        "fill_mode": rr.components.FillMode.Solid,
    }
    centre, size = np.array(geometry.position), geometry.size
    if geometry.shape == "box":
        return rr.Boxes3D(half_sizes=[size[:3]], centers=[centre], **style)
    if geometry.shape == "plane":  # Rerun has none: a thin box below it
        sides = [side or ENDLESS for side in size[:2]]
        below = centre - rotate(np.array(geometry.quaternion), np.array([0.0, 0.0, _THIN]))
        return rr.Boxes3D(half_sizes=[[*sides, _THIN]], centers=[below], **style)
    if geometry.shape == "ellipsoid":
        return rr.Ellipsoids3D(half_sizes=[size], centers=[centre], **style)
    if geometry.shape == "sphere":
        return rr.Ellipsoids3D(radii=[size[0]], centers=[centre], **style)
    if geometry.shape == "cylinder":
        return rr.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], centers=[centre], **style)
    # MuJoCo's capsule is centred, Rerun's starts where its axis begins.
    start = centre - rotate(np.array(geometry.quaternion), np.array([0.0, 0.0, size[1]]))
    return rr.Capsules3D(radii=[size[0]], lengths=[2 * size[1]], translations=[start], **style)


def _xyzw(quaternion: FloatArray) -> FloatArray:
    return np.roll(quaternion, -1, axis=-1)


def _taxels(tip: Geometry) -> str:
    return f"/world/{tip.body}/taxels"


def _scalars(values: FloatArray) -> rr.ComponentColumnList:
    count, width = values.shape
    return rr.Scalars.columns(scalars=values.reshape(-1)).partition(np.full(count, width))


def _image_style(shape: tuple[int, int]) -> rr.DepthImage:
    height, width = shape
    return rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(width=width, height=height, channel_datatype="F32"),
        colormap=rr.components.Colormap.Viridis,
        depth_range=(0.0, TOP_FORCE),
        magnification_filter=rr.components.MagnificationFilter.Nearest,
    )


def _joint_names() -> list[str]:
    return [name.replace("_", " ") for name in JOINTS]


def _joint_colours() -> list[Colour]:
    """A finger's colour in shades from its first joint to its last."""
    out = []
    for name in JOINTS:
        finger, number = name.split("_")
        shaded = [min(255, round(c * _SHADES[int(number) - 1])) for c in FINGER_COLOURS[finger]]
        out.append((shaded[0], shaded[1], shaded[2]))
    return out
