"""A scene and its rollouts as Rerun entities: what never changes, and columns for what moves.

Bodies hang flat below /world: /world/<body>, with its geometries as children.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr

from farm.sim.channels import Camera
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.base import TaskSpec
from learner.recording.channels import ChannelDrawing, Columns, scalars
from learner.recording.curves import lines
from learner.recording.solids import solid, xyzw
from learner.setup import Problem


class Drawing:
    """How a task's scene and rollouts are drawn."""

    def __init__(self, scene: Scene, spec: TaskSpec, camera: Camera | None = None) -> None:
        """Of a scene, with the channels of its task; seen from a camera, or (None) from beside what moves."""
        self.scene, self.spec, self.camera = scene, spec, camera
        self._channels = {channel.name: ChannelDrawing(channel, scene) for channel in spec.channels}

    @classmethod
    def of(cls, problem: Problem) -> "Drawing":
        """How a run's task is drawn."""
        return cls(problem.scene, problem.spec, problem.task.camera)

    def static(self) -> Iterator[tuple[str, Any]]:
        """Entities and archetypes that are logged once."""
        yield "/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP
        for geometry in self.scene.geometries():
            yield f"/world/{geometry.body}/{geometry.name}", solid(geometry)
        rest = self.scene.poses(self.scene.model.qpos0[None])[0]
        for name, pose in zip(self.scene.bodies, rest, strict=True):
            if name in self.scene.fixed:
                turned = rr.Quaternion(xyzw=xyzw(pose[3:]))
                yield f"/world/{name}", rr.Transform3D(translation=pose[:3], quaternion=turned)
        yield "/reward/terms", lines(self.spec.terms)
        yield "/actions", lines([str(i + 1) for i in range(self.spec.action)])
        for channel in self._channels.values():
            yield from channel.static()

    def check(self, rollout: Trajectory) -> None:
        """Check that a rollout is one of this scene and task: a ValueError says why not."""
        count, arrays = len(rollout.times), rollout.arrays()
        for name, shape in self.spec.shapes(len(self.scene.bodies)).items():
            found = arrays[name].shape if name in arrays else None
            if found != (count, *shape):
                raise ValueError(f"{name} of shape {found}, expected {(count, *shape)}: another scene or task?")

    def columns(self, rollout: Trajectory) -> Iterator[Columns]:
        """Columns of a rollout's frames, or of those of several that are joined; it is checked first."""
        self.check(rollout)
        for name, poses in zip(self.scene.bodies, np.moveaxis(rollout.bodies, 1, 0), strict=True):
            if name not in self.scene.fixed:
                moved = rr.Transform3D.columns(translation=poses[:, :3], quaternion=xyzw(poses[:, 3:]))
                yield Columns(f"/world/{name}", moved)
        yield Columns("/reward/terms", scalars(rollout.terms))
        yield Columns("/actions", scalars(rollout.actions))
        begins = np.cumsum(rollout.times == 0.0)
        for name, channel in self._channels.items():
            yield from channel.columns(rollout.channels[name], rollout.bodies, begins)
