"""Closed-loop rollouts of the finger gait, many at a time, in mujoco.batch.

A rollout's numbers depend on (task, controller parameters, perturbation) alone: not on which
others share its batch, on their order, or on threads. They equal, bit for bit, those of one
rollout at a time in a plain `mj_step` loop.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import mujoco
import mujoco.batch
import numpy as np

from farm.arrays import AnyArray, BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.policies.fourier import Policy
from farm.sim import scene as scenes
from farm.sim.scene import CONTACT_WIDTH, CONTACTS, HandScene
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS
from farm.tasks.finger_gait.rewards import Demonstration
from farm.tasks.finger_gait.task import SUBSTEPS, FingerGait, Frames, Outcome, Perturbation, TaskConfig, touching

CAPACITY: Final = 64
"""Rollouts that a worker steps together; more are done in turns."""

CLOSING: Final = 100
"""Physics steps in which a grip is closed round the frozen object."""

RAMP: Final = 50
"""Physics steps of them in which the commands move from waiting to gripping."""

SETTLE: Final = 50
"""Physics steps from the release of the goal grip until its demonstration is recorded."""

HOLD: Final = 200
"""Physics steps from the release for which a grip must hold the object by itself to be taken."""

LIMIT: Final = 1e8
"""A state beyond it has blown up, finite or not."""


@dataclass(frozen=True)
class Start:
    """Rollouts at the moment of release."""

    rows: FloatArray
    """(B, nstate) simulator states."""
    frames: Frames
    """(B,) what is measured there."""


@dataclass(frozen=True)
class Rollouts:
    """Rollouts that are over, and how they went."""

    outcome: Outcome
    start: Frames
    """(B,) at release."""
    frames: Frames
    """(B, F), F = T, or T x SUBSTEPS at physics rate; zero after the end."""
    targets: FloatArray
    """(B, T, 8) joint targets [rad], zero after the end."""
    actions: FloatArray
    """(B, T, 8) raw actions, zero after the end."""


class Stepper:
    """A mujoco.batch of simulations of one scene, with what is measured bound."""

    def __init__(self, scene: HandScene, capacity: int, *, perturbed: bool, threads: int = 1) -> None:
        """Perturbed simulations have friction and mass of their own."""
        self.scene = scene
        self.batch = mujoco.batch.Batch(scene.model, capacity, threads)
        self.state: FloatArray = self.batch.state
        self.ctrl = self.batch.bind("ctrl")
        self._qpos = self.batch.bind("qpos")
        self._sensors = self.batch.bind("sensordata")
        self._sites = self.batch.bind("site_xpos")
        self._axes = self.batch.bind("site_xmat")
        if perturbed:
            self._friction = self.batch.expand("geom_friction")
            self._mass = self.batch.expand("body_mass")
            self._inertia = self.batch.expand("body_inertia")

    def step(self, ids: IntArray, count: int) -> None:
        """Advance the simulations of these ids by physics steps."""
        with self._failures():
            self.batch.step(ids, nstep=count)

    def play(self, ids: IntArray, controls: FloatArray) -> None:
        """Advance the simulations of these ids by one physics step for each of their controls, (n, steps, 8)."""
        with self._failures():
            self.batch.rollout(controls.shape[1], controls, int(mujoco.mjtState.mjSTATE_CTRL), record=(), ids=ids)

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """A simulation in which MuJoCo itself raised counts as blown up; the others went on."""
        try:
            yield
        except mujoco.batch.SimulationError as error:
            self.state[error.ids] = np.nan

    def frames(self, ids: IntArray) -> Frames:
        """Measure: joint positions now, forces as of the last physics step's beginning (as mj_step leaves them)."""
        sensors = self._sensors[ids].reshape(len(ids), len(FINGERS), CONTACTS, CONTACT_WIDTH)
        centre = self._sites[ids][:, :, None, :]
        axes = self._axes[ids].reshape(len(ids), len(FINGERS), 1, 3, 3)
        difference = sensors[..., 4:7] - centre
        place = (
            axes[..., 0, :] * difference[..., 0:1]
            + axes[..., 1, :] * difference[..., 1:2]
            + axes[..., 2, :] * difference[..., 2:3]
        )
        found = sensors[..., 0] > 0
        force = np.where(found, sensors[..., 1], 0.0)
        return Frames(qpos=self._qpos[ids], force=force, place=np.where(found[..., None], place, 0.0))

    def blown_up(self, ids: IntArray) -> BoolArray:
        """Whose state is no longer a reasonable number, (n,)."""
        return np.asarray(~(np.abs(self.state[ids]) < LIMIT).all(axis=1))

    def set_conditions(self, perturbations: Sequence[Perturbation]) -> None:
        """Give the first simulations the friction and mass of these perturbations."""
        model, body = self.scene.model, self.scene.object_body
        for sim, perturbation in enumerate(perturbations):
            self._friction[sim] = model.geom_friction * perturbation.friction
            self._mass[sim, body] = model.body_mass[body] * perturbation.mass
            self._inertia[sim, body] = model.body_inertia[body] * perturbation.mass
        self.batch.set_const(np.arange(len(perturbations)))


class Simulation:
    """Simulates controllers of one run: closes the grips once, then runs rollouts."""

    def __init__(self, config: TaskConfig, policy: Policy, threads: int = 1, capacity: int = CAPACITY) -> None:
        """Close start and goal grip, record the demonstration.

        Args:
          config: the task.
          policy: the controller.
          threads: of the physics; the rest of a step runs on one.
          capacity: rollouts stepped together; more are done in turns.

        Raises:
          ConfigError: unknown object, one that the fingers cannot reach, or a grip that does not hold it.
        """
        scenes.quiet()
        self.scene = scenes.load(config.object)
        self.policy = policy
        grasping = Grasping(self.scene)
        self._waiting = grasping.command(())
        self._commands = grasping.command(GRIPS[config.start_grip])
        self._nominal = Stepper(self.scene, capacity, perturbed=False, threads=threads)
        self._perturbed: Stepper | None = None
        self._threads, self._capacity = threads, capacity
        self._demonstrate(config.start_grip, self._commands)
        goal = self._demonstrate(config.goal_grip, grasping.command(GRIPS[config.goal_grip]))
        self.task = FingerGait(config, goal, self._commands)
        self.start = self._close(self._nominal, self._commands, np.zeros((1, 3)))

    def run(
        self, theta: FloatArray, perturbations: Sequence[Perturbation | None], substeps: int = SUBSTEPS
    ) -> Rollouts:
        """Run rollouts to their ends.

        Args:
          theta: (B, P) controller parameters.
          perturbations: (B,) what is different in each; equal objects share a closing of the grip.
          substeps: physics steps between two recorded frames: SUBSTEPS, or 1 for physics rate.
        """
        order = sorted(range(len(theta)), key=lambda i: perturbations[i] is not None)
        parts, done = [], 0
        nominal = sum(p is None for p in perturbations)
        while done < len(order):
            stop = min(done + self._capacity, nominal if done < nominal else len(order))
            chosen = order[done:stop]
            parts.append(self._run(theta[chosen], [perturbations[i] for i in chosen], substeps))
            done = stop
        return _reorder(parts, np.argsort(order))

    def _run(self, theta: FloatArray, perturbations: list[Perturbation | None], substeps: int) -> Rollouts:
        count, steps = len(theta), self.task.config.steps
        stepper, start, noise = self.begin(perturbations)
        weights = self.policy.weights(theta)
        record = Recording(count, steps, SUBSTEPS // substeps, start.frames)
        last = np.broadcast_to(self._commands, (count, len(JOINTS)))
        now = start.frames
        active = np.arange(count)
        for t in range(steps):
            x = self.task.observe(now, None if noise is None else noise[active, t])
            actions = self.policy.actions(weights, x)
            last = self.policy.targets(actions, self._commands, last)
            stepper.ctrl[active] = last
            record.act(t, active, actions, last)
            for part in range(SUBSTEPS // substeps):
                stepper.step(active, substeps)
                now = stepper.frames(active)
                record.measure(t, part, active, now)
            failed = stepper.blown_up(active)
            going = ~failed & touching(now.force)
            if not going.all():
                record.end(t, active[~going], active[failed])
                active, last, weights = active[going], last[going], weights[going]
                now = Frames(now.qpos[going], now.force[going], now.place[going])
                if not len(active):
                    break
        return record.rollouts(self.task)

    def begin(self, perturbations: list[Perturbation | None]) -> tuple[Stepper, Start, FloatArray | None]:
        """Put as many simulations as there are perturbations at their moment of release."""
        count = len(perturbations)
        real = [p for p in perturbations if p is not None]
        if not real:
            start = Start(np.repeat(self.start.rows, count, axis=0), self.start.frames.at([0] * count))
            self._nominal.state[:count] = start.rows
            return self._nominal, start, None
        if self._perturbed is None:
            self._perturbed = Stepper(self.scene, self._capacity, perturbed=True, threads=self._threads)
        first = {id(p): i for i, p in reversed(list(enumerate(real)))}
        own = sorted(first.values())
        self._perturbed.set_conditions(real)
        displaced = np.stack([real[i].displacement for i in own])
        start = self._close(self._perturbed, self._commands, displaced, np.array(own))
        copies = [own.index(first[id(p)]) for p in real]
        start = Start(start.rows[copies], start.frames.at(copies))
        self._perturbed.state[:count] = start.rows
        return self._perturbed, start, np.stack([p.noise for p in real])

    def _close(
        self, stepper: Stepper, commands: FloatArray, displaced: FloatArray, ids: IntArray | None = None
    ) -> Start:
        """Close a grip round the frozen object, displaced by (n, 3) [m], and release it."""
        ids = np.arange(len(displaced)) if ids is None else ids
        stepper.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        place = slice(len(JOINTS), len(JOINTS) + 3)
        qpos, anchor = stepper.batch.bind("qpos"), stepper.batch.bind("mocap_pos")
        qpos[ids, : len(JOINTS)] = self._waiting
        qpos[ids, place] += displaced
        anchor[ids, 0] = qpos[ids, place]
        stepper.batch.bind("mocap_quat")[ids, 0] = qpos[ids, place.stop :]
        part = np.minimum(1.0, np.arange(1, CLOSING + 1) / RAMP)[:, None]
        ramp = self._waiting + (commands - self._waiting) * part
        stepper.play(ids, np.broadcast_to(ramp, (len(ids), *ramp.shape)))
        stepper.batch.bind("eq_active")[ids] = 0
        return Start(stepper.state[ids].copy(), stepper.frames(ids))

    def _demonstrate(self, grip: str, commands: FloatArray) -> Demonstration:
        """Close a grip, release, let it settle, and record it.

        Raises:
          ConfigError: it does not hold the object.
        """
        self._close(self._nominal, commands, np.zeros((1, 3)))
        ids = np.zeros(1, dtype=np.int64)
        self._nominal.step(ids, SETTLE)
        frames = self._nominal.frames(ids)
        self._nominal.step(ids, HOLD - SETTLE)
        if not touching(self._nominal.frames(ids).force)[0]:
            raise ConfigError(f"grip {grip!r} does not hold object {self.scene.object_name!r}; take another grip")
        images = tactile.image(frames.force, frames.place)
        return Demonstration(joints=frames.joints[0], images=images[0], points=tactile.contact_points(images)[0])


class Recording:
    """Arrays that rollouts are written into as they go on."""

    def __init__(self, count: int, steps: int, parts: int, start: Frames) -> None:
        """Make room for rollouts that start like this (B,), a frame each part of a control step."""
        self.parts = parts
        self.start = start
        shape = (count, steps * parts)
        self.frames = Frames(
            qpos=np.zeros((*shape, *start.qpos.shape[1:])),
            force=np.zeros((*shape, *start.force.shape[1:])),
            place=np.zeros((*shape, *start.place.shape[1:])),
        )
        self.actions = np.zeros((count, steps, len(JOINTS)))
        self.targets = np.zeros((count, steps, len(JOINTS)))
        self.steps = np.full(count, steps)
        self.failed = np.zeros(count, dtype=bool)

    def act(self, t: int, active: IntArray, actions: FloatArray, targets: FloatArray) -> None:
        """Note what rollouts (n,) do in a control step, (n, 8) each."""
        self.actions[active, t], self.targets[active, t] = actions, targets

    def measure(self, t: int, part: int, active: IntArray, now: Frames) -> None:
        """Note what is measured of them after a part of it."""
        frame = t * self.parts + part
        self.frames.qpos[active, frame] = now.qpos
        self.frames.force[active, frame] = now.force
        self.frames.place[active, frame] = now.place

    def end(self, t: int, ended: IntArray, failed: IntArray) -> None:
        """Note which rollouts this step ended, and in which of them the physics blew up."""
        self.steps[ended] = t + 1
        self.failed[failed] = True
        frames = slice(t * self.parts, (t + 1) * self.parts)
        for values in (self.frames.qpos, self.frames.force, self.frames.place):
            values[failed, frames] = 0.0  # no number of a blown-up state goes any further

    def rollouts(self, task: FingerGait) -> Rollouts:
        """Judge them, when all are over."""
        at = slice(self.parts - 1, None, self.parts)
        control = Frames(self.frames.qpos[:, at], self.frames.force[:, at], self.frames.place[:, at])
        outcome = task.judge(control, self.actions, self.start.pose, self.steps, self.failed)
        return Rollouts(outcome, self.start, self.frames, self.targets, self.actions)


def _reorder(parts: list[Rollouts], order: IntArray) -> Rollouts:
    """Put chunks behind each other and rows back into the order they were asked for."""

    def join(*arrays: AnyArray) -> AnyArray:
        return np.concatenate(arrays)[order] if len(arrays) > 1 or len(order) > 1 else arrays[0]

    def fields(values: Sequence[object]) -> object:
        if isinstance(values[0], np.ndarray):
            return join(*values)  # type: ignore[arg-type]
        kind = type(values[0])
        return kind(*(fields([getattr(v, name) for v in values]) for name in kind.__dataclass_fields__))  # type: ignore[attr-defined]

    return fields(parts)  # type: ignore[return-value]
