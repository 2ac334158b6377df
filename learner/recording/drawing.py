"""A scene and its rollouts as Rerun entities: static parts, and columns for moving ones.

All bodies are directly below /world: /world/<body>, with its geometries as children.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray
from farm.sim.channels import Camera
from farm.sim.scene import Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.base import TaskSpec
from learner.recording.blueprint import Eye
from learner.recording.channels import ChannelDrawing, Columns, scalars
from learner.recording.curves import lines
from learner.recording.solids import solid, xyzw
from learner.setup import Problem

CAPTION: Final = "/world/caption"
"""Entity of the text in the scene."""

_WHITE: Final = (255, 255, 255)
_ABOVE: Final = 0.75  # height of the caption above the scene's middle, in radii of the scene


class Drawing:
    """How a task's scene and rollouts are drawn."""

    def __init__(self, scene: Scene, spec: TaskSpec, camera: Camera | None = None) -> None:
        """Draw a scene with its task's channels; seen from a camera, or (None) from the side of the moving bodies."""
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
        yield CAPTION, rr.Points3D.from_fields(colors=[_WHITE], radii=[0.0], show_labels=True)
        yield "/reward/terms", lines(self.spec.terms)
        yield "/actions", lines([str(i + 1) for i in range(self.spec.action)])
        for channel in self._channels.values():
            yield from channel.static()

    def check(self, rollout: Trajectory) -> None:
        """Check that a rollout belongs to this scene and task; raises ValueError otherwise."""
        count, arrays = len(rollout.times), rollout.arrays()
        for name, shape in self.spec.shapes(len(self.scene.bodies)).items():
            found = arrays[name].shape if name in arrays else None
            if found != (count, *shape):
                raise ValueError(f"{name} of shape {found}, expected {(count, *shape)}: another scene or task?")

    def captions(self, rollouts: Sequence[tuple[str, Trajectory]]) -> Columns:
        """Texts in the scene for the frames of named rollouts, one rollout after the other.

        Each has the rollout's name, return and success, and how far the first free body has moved since its start.
        """
        eye = Eye.of(self.scene, self.camera)
        place = eye.target + (0.0, 0.0, _ABOVE * self.scene.radius)
        followed = self.scene.mover.body if eye.tracked and self.scene.mover else None
        places = [place + self._moved(rollout, followed) for _, rollout in rollouts]
        texts = [text for name, rollout in rollouts for text in self._texts(name, rollout)]
        values = rr.Points3D.columns(positions=np.concatenate(places), labels=texts)
        return Columns(CAPTION, values.partition(np.ones(len(texts), dtype=int)))

    def _moved(self, rollout: Trajectory, body: str | None) -> FloatArray:
        """Displacement of a body since the start [m], (F, 3); zero without a body."""
        if body is None:
            return np.zeros((len(rollout.times), 3))
        places = rollout.bodies[:, self.scene.bodies.index(body), :3]
        return places - places[0]

    def _texts(self, name: str, rollout: Trajectory) -> list[str]:
        success = {True: "success", False: "no success", None: ""}[rollout.success]
        value = "" if np.isnan(rollout.value) else f"return {rollout.value:.3f}"
        head = "\n".join(filter(None, (name, ", ".join(filter(None, (value, success))))))
        if self.scene.free is None:
            return [head] * len(rollout.times)
        moved = np.linalg.norm(self._moved(rollout, self.scene.free), axis=1)
        return [f"{head}\n{self.scene.free} moved {_length(each)}" for each in moved.tolist()]

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


def _length(metres: float) -> str:
    return f"{1000 * metres:.1f} mm" if metres < 1.0 else f"{metres:.2f} m"
