"""Whether what moves is inside a picture: MuJoCo's camera, computed here from its definition."""

import numpy as np

from farm.sim.framing import View
from farm.sim.scene import Scene

HALF_FIELD = np.deg2rad(45.0) / 2.0
"""Half of MuJoCo's default vertical field of view."""


def inside(
    scene: Scene, view: View, bodies: np.ndarray, size: tuple[int, int] = (480, 360)
) -> np.ndarray:
    """Whether the origins of all moving bodies (F, B, 7) are inside a picture of this size, in each
    frame (F,).
    """
    moving = [at for at, name in enumerate(scene.bodies) if name not in scene.fixed]
    camera = view.camera
    a, e = np.deg2rad([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    up = np.cross(right, ahead)
    targets = np.tile(camera.lookat, (len(bodies), 1))
    if view.mover is not None:
        targets = targets + view.shifts(bodies[:, scene.bodies.index(view.mover.body), :3])
    rays = bodies[:, moving, :3] - (targets - camera.distance * ahead)[:, None]
    depth, wide, high = rays @ ahead, rays @ right, rays @ up
    most = np.tan(HALF_FIELD) * depth
    return ((depth > 0.0) & (np.abs(high) < most) & (np.abs(wide) < most * size[0] / size[1])).all(
        axis=1
    )
