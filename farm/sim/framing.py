"""Where a scene is seen from: by a task's camera, or from beside what moves, so far away that all
of it is in view.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import mujoco
import numpy as np

from farm.arrays import FloatArray, IntArray
from farm.sim.channels import Camera
from farm.sim.scene import Scene

BESIDE: Final = (106.0, -25.0)
"""Azimuth and elevation from which a scene without a camera of its own is seen [deg]: most robots
walk along x.
"""

AWAY: Final = 2.9
"""Distance from which it is seen, in radii of the sphere that must be in view; MuJoCo's field of
view needs 2.6.
"""

SLACK: Final = 0.4
"""How far what is followed may be from the middle before the camera moves, in radii of what moves.
"""

# Times as large as what moves must the box around its whole way be, for the camera to follow
_TRAVELS: Final = 2.0
# Radii of what moves, beyond which something has fallen away and is not kept in view
_LARGEST: Final = 6.0
_POSES: Final = 128  # sampled poses within the joints' ranges


class View:
    """A point of view: a task's camera, which stays; or beside what moves, whole rollouts in view.

    What travels is followed, and only as far as it leaves the middle: a swinging pendulum does not
    swing the scene.
    """

    def __init__(
        self, scene: Scene, camera: Camera | None, rollouts: Sequence[FloatArray] = ()
    ) -> None:
        """Choose it.

        Args:
          scene: what is seen, with the start in which it is framed.
          camera: the task's own; it stays.
          rollouts: poses of the scene's bodies in rollouts that will be shown, (F, B, 7) each.
            Without any, whatever the joints can reach from a fixed base is in view.
        """
        self.camera = camera or beside(scene)
        """Camera at the start."""
        self.mover = None if camera else scene.mover
        """Body that the camera follows; None: it stays."""
        self._shift = np.zeros(3)
        if self.mover is None:
            return
        spheres = _Spheres(scene)
        if not rollouts:
            self._frame(spheres.centres(_reach(scene)), spheres.radii)
            return
        ways = [spheres.centres(poses) for poses in rollouts]
        reach = self._reach(scene, rollouts, ways, spheres.radii)
        near = reach <= _LARGEST * self.mover.radius  # the others have fallen away
        near = near if near.any() else np.ones_like(near)
        ways, radii = [way[:, near] for way in ways], spheres.radii[near]
        largest = max(
            float(_radius(way, _middle(way, radii, each=True), radii).max()) for way in ways
        )
        if self._frame(np.concatenate(ways), radii) <= _TRAVELS * largest:
            self.mover = None
            return
        self.camera = replace(
            self.camera, lookat=self.mover.centre, distance=AWAY * float(reach[near].max())
        )

    def _reach(
        self,
        scene: Scene,
        rollouts: Sequence[FloatArray],
        ways: Sequence[FloatArray],
        radii: FloatArray,
    ) -> FloatArray:
        """How far each sphere (G,) is ever from where a camera looks that follows [m]."""
        assert self.mover is not None
        index = scene.bodies.index(self.mover.body)
        reach = np.zeros(len(radii))
        for poses, way in zip(rollouts, ways, strict=True):
            targets = self.mover.centre + self.shifts(poses[:, index, :3])
            reach = np.maximum(reach, _radius(way, targets[:, None], radii).max(axis=0))
        return reach

    def _frame(self, way: FloatArray, radii: FloatArray) -> float:
        """Let the camera see spheres (F, G, 3) of these radii (G,).

        Returns the radius of the one around them [m].
        """
        middle = _middle(way, radii)
        radius = float(_radius(way, middle, radii).max())
        x, y, z = middle.tolist()
        self.camera = replace(self.camera, lookat=(x, y, z), distance=AWAY * radius)
        return radius

    def moved(self, place: FloatArray) -> FloatArray:
        """Move the camera if the body, now at this place, needs it; return the step [m], (3,)."""
        assert self.mover is not None
        away = place - self.mover.place - self._shift
        slack = SLACK * self.mover.radius
        step = away * (1.0 - slack / max(float(np.linalg.norm(away)), slack))
        self._shift += step
        return step

    def shifts(self, places: FloatArray) -> FloatArray:
        """Displacements of the camera from the start when the body is at each of these places,
        (F, 3) [m].
        """
        self.back()
        shifts = np.cumsum([self.moved(place) for place in places], axis=0)
        self.back()
        return shifts

    def back(self) -> FloatArray:
        """Move the camera back to the start; return the step [m], (3,)."""
        step, self._shift = -self._shift, np.zeros(3)
        return step


def beside(scene: Scene) -> Camera:
    """The default camera: looks at the moving bodies, or at the middle of the scene if nothing
    moves.
    """
    x, y, z = scene.model.stat.center.tolist() if scene.mover is None else scene.mover.centre
    return Camera(
        lookat=(x, y, z), distance=AWAY * scene.radius, azimuth=BESIDE[0], elevation=BESIDE[1]
    )


class _Spheres:
    """Spheres around all geometries that move, of all models of a scene, fixed to its drawn
    bodies.
    """

    def __init__(self, scene: Scene) -> None:
        bodies = []
        offsets = []
        radii = []
        for each in scene.each:
            model = each.model
            bodies_of_model = sorted(set(model.geom_bodyid.tolist()))
            for geom in range(model.ngeom):
                body = int(model.geom_bodyid[geom])
                if model.body_weldid[body] != 0 and model.geom_rbound[geom] > 0.0:
                    bodies.append(bodies_of_model.index(body))
                    offsets.append(model.geom_pos[geom])
                    radii.append(float(model.geom_rbound[geom]))
        self._bodies: IntArray = np.array(bodies, dtype=int)
        self._offsets = np.array(offsets)
        self.radii = np.array(radii)
        """[m], (G,)"""

    def centres(self, poses: FloatArray) -> FloatArray:
        """Centres of the spheres (F, G, 3) [m] with the bodies in these poses, (F, B, 7)."""
        transforms = np.asarray(poses, dtype=float)[:, self._bodies]
        w, v = transforms[..., 3:4], transforms[..., 4:]
        across = 2.0 * np.cross(v, np.broadcast_to(self._offsets, v.shape))
        turned: FloatArray = transforms[..., :3] + self._offsets + w * across + np.cross(v, across)
        return turned


def _middle(way: FloatArray, radii: FloatArray, *, each: bool = False) -> FloatArray:
    """Middle of the box around spheres (F, G, 3), (3,); or of that of each frame, (F, 1, 3)."""
    axes = 1 if each else (0, 1)
    low, high = (way - radii[:, None]).min(axis=axes), (way + radii[:, None]).max(axis=axes)
    middle: FloatArray = 0.5 * (low + high)
    return middle[:, None] if each else middle


def _radius(way: FloatArray, middle: FloatArray, radii: FloatArray) -> FloatArray:
    """How far spheres (F, G, 3) reach from a middle, (F, G)."""
    reach: FloatArray = np.linalg.norm(way - middle, axis=2) + radii
    return reach


def _reach(scene: Scene) -> FloatArray:
    """Poses (F, B, 7) at the start, and with joints between a fixed base and there anywhere in
    their ranges.

    Hinges without a range turn once around. Slides without one stay, and so does what is free to
    travel.
    """
    model = scene.model
    start = model.qpos0 if scene.start is None else scene.start
    qpos = np.tile(start, (_POSES, 1))
    shares = np.random.default_rng(0).uniform(size=(_POSES, model.njnt))
    free = {
        int(model.body_rootid[body])
        for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    }
    slides = {int(body) for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]}
    for joint in range(model.njnt):
        kind = int(model.jnt_type[joint])
        body = int(model.jnt_bodyid[joint])
        at = int(model.jnt_qposadr[joint])
        hinge = kind == mujoco.mjtJoint.mjJNT_HINGE
        limited = bool(model.jnt_limited[joint])
        planar = hinge and not limited and body in slides  # the root of what walks in a plane
        if (
            not (hinge or kind == mujoco.mjtJoint.mjJNT_SLIDE)
            or int(model.body_rootid[body]) in free
            or planar
        ):
            continue
        low, high = (
            model.jnt_range[joint]
            if limited
            else (-np.pi, np.pi)
            if hinge
            else (start[at], start[at])
        )
        qpos[1:, at] = low + shares[1:, joint] * (high - low)
    mocap = None if scene.mocap is None else np.tile(scene.mocap, (_POSES, 1, 1))
    return scene.poses(qpos, mocap)
