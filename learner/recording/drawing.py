"""A scene and its rollouts as Rerun entities: static parts, and columns for moving ones.

All bodies are directly below /world: /world/<body>, with its geometries as children.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import rerun as rr

from farm.arrays import FloatArray
from farm.sim.channels import Camera
from farm.sim.framing import View
from farm.sim.scene import MODEL, Scene
from farm.sim.trajectory import Trajectory
from farm.tasks.actions.numbers import described
from farm.tasks.base import TaskSpec
from farm.tasks.standard import start
from learner.recording.channels import KINDS
from learner.recording.curves import Columns, lines, scalars
from learner.recording.entities import CAPTION, FOLLOWED, SceneEntities
from learner.recording.eye import Eye
from learner.recording.solids import grid, solid, xyzw
from learner.run.setup import Problem

_WHITE: Final = (255, 255, 255)
_ABOVE: Final = 0.75  # height of the caption above the scene's middle, in radii of the scene


class Drawing:
    """How a task's scene and rollouts are drawn."""

    def __init__(
        self,
        scene: Scene,
        spec: TaskSpec,
        camera: Camera | None = None,
        actions: Sequence[str] = (),
    ) -> None:
        """Draw a scene with its task's channels.

        Args:
          scene: the model.
          spec: of the task.
          camera: from where it is seen; None: from the side of the moving bodies.
          actions: names of the action's numbers; empty: they are counted.
        """
        self.scene, self.spec, self.camera = scene, spec, camera
        self.actions = actions or [str(i + 1) for i in range(spec.action)]
        """Names of the action's numbers."""
        self._entities = SceneEntities(scene, spec.channels)
        self._channels = {
            channel.name: KINDS[channel.kind](channel, scene, self._entities)
            for channel in spec.channels
        }

    @classmethod
    def of(cls, problem: Problem) -> "Drawing":
        """Drawing of a run's task; without a camera of its own it is framed at its start."""
        task, scene = problem.task, problem.scene
        names = [each.name for each in described(task, problem.spec.action)]
        if task.camera:
            return cls(scene, problem.spec, task.camera, names)
        qpos, mocap = start(task)
        return cls(replace(scene, start=qpos, mocap=mocap), problem.spec, actions=names)

    def static(self) -> Iterator[tuple[str, Any]]:
        """Entities and archetypes that are logged once."""
        yield "/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP
        for entity, geometry in self._entities.geometries:
            yield entity, solid(geometry)
            if geometry.grid:
                yield f"{entity}/grid", grid(geometry)
        rest = self.scene.poses(self.scene.model.qpos0[None])[0]
        for name, entity, pose in zip(self.scene.bodies, self._entities.bodies, rest, strict=True):
            if name in self.scene.fixed:
                turned = rr.Quaternion(xyzw=xyzw(pose[3:]))
                yield entity, rr.Transform3D(translation=pose[:3], quaternion=turned)
        yield CAPTION, rr.Points3D.from_fields(colors=[_WHITE], radii=[0.0], show_labels=True)
        if self.camera is None:
            yield FOLLOWED, rr.Points3D.from_fields(radii=[0.0])
        yield "/reward/terms", lines(self.spec.terms)
        yield "/actions", lines(self.actions)
        for channel in self._channels.values():
            yield from channel.static()

    def check(self, rollout: Trajectory) -> None:
        """Check that a rollout belongs to this scene and task; raises ValueError otherwise."""
        count, arrays = len(rollout.times), rollout.arrays()
        for name, shape in self.spec.shapes(len(self.scene.bodies)).items():
            present = arrays[name].shape if name in arrays else None
            if present != (count, *shape):
                raise ValueError(
                    f"{name} of shape {present}, expected {(count, *shape)}: another scene or task?"
                )

    def view(self, rollouts: Sequence[Trajectory] = ()) -> View:
        """View of the scene in which all of these rollouts is seen, or what can be reached from the
        start.
        """
        return View(self.scene, self.camera, [rollout.bodies for rollout in rollouts])

    def captions(
        self, rollouts: Sequence[tuple[str, Trajectory]], view: View | None = None
    ) -> Iterator[Columns]:
        """Texts in the scene for the frames of named rollouts, one rollout after the other; and
        what the eye follows.

        Each has the rollout's name, return and success, and how far the first free body has moved
        since its start. The view is the one that the eye was placed by; by default that of the
        start.
        """
        view = view or self.view()
        eye = Eye.of(view)
        shifts = np.concatenate([self._shifts(rollout, view) for _, rollout in rollouts])
        texts = [text for name, rollout in rollouts for text in self._texts(name, rollout)]
        place = eye.target + (0.0, 0.0, _ABOVE * self.scene.radius)
        values = rr.Points3D.columns(positions=place + shifts, labels=texts)
        one = np.ones(len(texts), dtype=int)
        yield Columns(CAPTION, values.partition(one))
        if eye.tracked:
            yield Columns(
                eye.tracked, rr.Points3D.columns(positions=eye.target + shifts).partition(one)
            )

    def _shifts(self, rollout: Trajectory, view: View) -> FloatArray:
        """How far the eye has moved since the start [m], (F, 3)."""
        if view.mover is None:
            return np.zeros((len(rollout.times), 3))
        return view.shifts(rollout.bodies[:, self.scene.bodies.index(view.mover.body), :3])

    def _texts(self, name: str, rollout: Trajectory) -> list[str]:
        head = rollout.caption(name)
        if self.scene.free is None:
            return [head] * len(rollout.times)
        places = rollout.bodies[:, self.scene.bodies.index(self.scene.free), :3]
        moved = np.linalg.norm(places - places[0], axis=1)
        return [f"{head}\n{self.scene.free} moved {_length(each)}" for each in moved.tolist()]

    def columns(self, rollout: Trajectory) -> Iterator[Columns]:
        """Columns of a rollout's frames, or of those of several that are joined.

        It is checked first.
        """
        self.check(rollout)
        all_poses = np.moveaxis(rollout.bodies, 1, 0)
        for name, entity, poses in zip(
            self.scene.bodies, self._entities.bodies, all_poses, strict=True
        ):
            if name not in self.scene.fixed:
                moved = rr.Transform3D.columns(
                    translation=poses[:, :3], quaternion=xyzw(poses[:, 3:])
                )
                yield Columns(entity, moved)
        for entity, geometry in self._entities.geometries:
            if not geometry.models:  # every model has it
                continue
            # A scale of 0 hides it
            visible = rollout.channels[MODEL][:, list(geometry.models)].sum(axis=1)
            yield Columns(
                entity, rr.Transform3D.columns(scale=np.repeat(visible[:, None], 3, axis=1))
            )
        yield Columns("/reward/terms", scalars(rollout.terms))
        yield Columns("/actions", scalars(rollout.actions))
        begins = np.cumsum(rollout.times == 0.0)
        for name, channel in self._channels.items():
            yield from channel.columns(rollout.channels[name], rollout.bodies, begins)

    def gaps(self, count: int) -> Iterator[Columns]:
        """Rows that break the curves: without them the viewer draws a line from each rollout to the
        next one.
        """
        widths = {"/reward/terms": len(self.spec.terms), "/actions": self.spec.action}
        for channel in self._channels.values():
            widths |= channel.curves()
        for entity, width in widths.items():
            yield Columns(entity, scalars(np.full((count, width), np.nan)))


def _length(metres: float) -> str:
    return f"{1000 * metres:.1f} mm" if metres < 1.0 else f"{metres:.2f} m"
