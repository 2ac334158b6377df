"""Tasks of the hand around an object: the grip that holds it at the start, its conditions, what is
measured and shown.

The hand closes a start grip around the frozen object and releases the object. For `steps` control
steps of SUBSTEPS x TIMESTEP the controller sets joint targets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from farm import elementary
from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.settings import Texts
from farm.sim.channels import Quantity
from farm.sim.sim import Sim
from farm.tasks.base import Camera, Channel, Task, TaskSpec
from farm.tasks.finger_gait import model, sensing, touch
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS, LOWER, POSES, TIP_RADIUS, UPPER
from farm.tasks.finger_gait.observations import STATES, Felt
from farm.tasks.finger_gait.sensing import Perturbation, SensingConfig

TIMESTEP: Final = 0.01
"""Length of a physics step [s]."""

SUBSTEPS: Final = 10
"""Physics steps per control step."""

CONTROL_PERIOD: Final = TIMESTEP * SUBSTEPS
"""Length of a control step [s]."""

PRESSES: Final = 0.1
"""Smallest force at which a fingertip counts as pressing [N]."""

SUCCESS_STEPS: Final = 3
"""Control steps at the end of a rollout over which success is judged."""

MAX_SHIFT: Final = 0.015
"""Largest distance of the object's centre from its position at the release [m]."""

MAX_TURN: Final = np.deg2rad(30.0)
"""Largest angle of the object from its orientation at the release [rad]."""

LEAST_COSINE: Final = float(elementary.cos(np.array(0.5 * MAX_TURN)))
"""Cosine of half of that."""

MOVED: Final = 0.003
"""Shift of the object that costs as much as TURNED [m]."""

TURNED: Final = np.deg2rad(6.0)
"""Turn of the object that costs as much as MOVED [rad]."""

TURNED_COSINE: Final = float(elementary.cos(np.array(0.5 * TURNED)))
"""Cosine of half of that."""

MOST_MOTION: Final = 20.0
"""Largest `motion`; tasks treat a lost object apart."""

CLOSING: Final = 100
"""Physics steps in which a grip is closed around the frozen object."""

RAMP: Final = 50
"""Physics steps of them in which the commands move from waiting to gripping."""

SETTLE: Final = 50
"""Physics steps from the release of the goal grip until its demonstration is recorded."""

HOLD: Final = 200
"""Physics steps after the release for which a grip must hold the object to be accepted."""

TARGET_LIMIT: Final = 1e6  # [rad]; keeps an unclipped target in MuJoCo's range
_COLOURS: Final = ((86, 180, 233), (0, 158, 115), (204, 121, 167))  # of the fingers
_SHADES: Final = (1.25, 0.95, 0.65)  # of a finger's joints, first to last


@dataclass(frozen=True, kw_only=True)
class ObjectConfig(SensingConfig):
    """Settings of a task whose object, or objects, a user chooses.

    Raises:
      ConfigError: there is no object, or two have the same name.
    """

    object: Texts
    """Object to be held: the name of a file in assets/objects, or a file NAME.xml of your own;
    of several each rollout has one.
    """

    def __post_init__(self) -> None:
        each = (self.object,) if isinstance(self.object, str) else self.object
        object.__setattr__(self, "object", each)
        super().__post_init__()
        # Paths, so that a run can be repeated from anywhere
        names = tuple(str(Path(name).resolve()) if name.endswith(".xml") else name for name in each)
        if len({Path(name).stem for name in names}) < len(names) or not names:
            raise ConfigError(
                f"object is {', '.join(names) or 'empty'}; expected one name, or several different"
                " ones"
            )
        object.__setattr__(self, "object", names if len(names) > 1 else names[0])


class HandTask(Task):
    """The hand holds an object in a grip; subclasses say what is to be done with it."""

    object: Texts
    """Object to be held: the name of a file in assets/objects, or a file NAME.xml; or several."""
    pose: str
    """How the hand is set up, one of POSES."""
    start_grip: str
    """Grip in which the object is released."""
    clip: bool = True
    """Whether joint targets are clipped to the joints' ranges."""
    terms: tuple[str, ...] = ()
    """Names of the reward's terms."""
    scales: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of joint positions, contact points and taxels in the state."""
    substeps = SUBSTEPS
    actions = tuple(Quantity(joint, "rad") for joint in JOINTS)
    ending = "dropped"
    camera = Camera(lookat=(0.035, 0.014, 0.01), distance=0.34, azimuth=150.0, elevation=-14.0)
    start_commands: FloatArray
    """Joint targets of the start grip for each object [rad], (M, 8)."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all M objects, of which each rollout has one; the first is the nominal one."""
        return (self.object,) if isinstance(self.object, str) else self.object

    def files(self) -> dict[str, str]:
        """Hand, objects, and what the task adds."""
        return model.files(self.objects, self.pose, self.config.stiffness)

    def mjcf(self) -> str:
        """Text of the model with the first object."""
        return model.mjcf(cast("Mapping[str, str]", self.sources))

    def models(self) -> list[str]:
        """Texts of the models, one for each object, if there are several objects."""
        return (
            model.texts(cast("Mapping[str, str]", self.sources), self.objects)
            if len(self.objects) > 1
            else []
        )

    @property
    def hand(self) -> model.Hand:
        """Indices into the model with the first object."""
        return self.hands[0]

    @cached_property
    def hands(self) -> tuple[model.Hand, ...]:
        """Indices into the model of each object."""
        pose = POSES[self.pose]
        return tuple(
            model.Hand(*pair, pose) for pair in zip(self.simulated, self.objects, strict=True)
        )

    @property
    def action(self) -> str:
        """What an action is: offset from the start grip's commands, absolute, or increment."""
        return str(self.config.action)

    @property
    def parts(self) -> tuple[int, ...]:  # type: ignore[override]  # a setting's
        """Sizes of the state base's parts."""
        return STATES[self.config.state].sizes

    @property
    def observations(self) -> tuple[Quantity, ...]:  # type: ignore[override]  # a setting's
        """The state base's numbers."""
        return STATES[self.config.state].quantities(self.scales)

    @property
    def zeroed(self) -> bool:
        """Whether a rollout begins with steps in which the hand holds still and finds its servos'
        zero.
        """
        return self.config.state in STATES and STATES[self.config.state].zeroed

    def spec(self) -> TaskSpec:
        """The task's specification, found without closing a grip."""
        return TaskSpec(
            observation=sum(self.parts),
            action=len(JOINTS),
            steps=self.steps,
            period=CONTROL_PERIOD,
            terms=self.terms,
            success=True,
            channels=self.channels,
        )

    # Beginning a rollout

    def setup(self, sim: Sim) -> None:
        """Find the start grip; a ConfigError if it does not hold an object."""
        self._find_start(sim)

    def _find_start(self, sim: Sim) -> list[Grasping]:
        """Find the commands of the start grip for each object, and check that it holds it."""
        sim.begin(1)
        # Requested before the search for the grip, which would start again otherwise
        self.measure(sim)
        grasping = [Grasping(hand) for hand, _ in zip(self.hands, sim.models, strict=False)]
        self._waiting = np.stack([each.command(()) for each in grasping])
        self.start_commands = np.stack([each.command(GRIPS[self.start_grip]) for each in grasping])
        for which, each in enumerate(self.start_commands):
            self._demonstrate(sim, self.start_grip, each, which)
        return grasping

    def _demonstrate(self, sim: Sim, grip: str, commands: FloatArray, which: int) -> Felt:
        """Close a grip of an object, release, let it settle, and record it."""
        sim.begin(1, np.array([which]))
        self._close(sim, commands[None], np.zeros((1, 3)))
        sim.step(SETTLE)
        felt = self.measure(sim)
        joints, images = sim.qpos[0, : len(JOINTS)].copy(), touch.images(felt)
        sim.step(HOLD - SETTLE)
        if not touching(self.measure(sim)["force"])[0]:
            press = self.hand.pose.press
            forces = " and ".join(f"{press[finger]:g} N ({finger})" for finger in GRIPS[grip])
            raise ConfigError(
                f"grip {grip!r} does not hold object {self.hands[which].object_name!r} in pose"
                f" {self.pose!r}, pressing with {forces}; take another grip, pose or object"
            )
        return Felt(joints=joints, images=images[0], points=touch.contact_points(images)[0])

    def prepare(self, sim: Sim, rngs: Sequence[np.random.Generator | None]) -> None:
        """Set friction and mass, close the start grip around the frozen object, and release the
        object.
        """
        nominal = Perturbation.none(self.steps)
        perturbations = [nominal if rng is None else self._drawn(rng) for rng in rngs]
        if self.config.friction != 1.0 or any(each is not nominal for each in perturbations):
            self._set_conditions(sim, perturbations)
        self._close(
            sim,
            self.start_commands[sim.which],
            np.stack([each.displacement for each in perturbations]),
        )
        for name in ("noise", "force_noise", "lost"):
            sim.own[name] = np.stack([getattr(each, name) for each in perturbations])
        sim.own["target"] = self.start_commands[sim.which]
        sim.own["released"] = sim.qpos[:, len(JOINTS) :].copy()

    def _drawn(self, rng: np.random.Generator) -> Perturbation:
        return Perturbation.draw(rng, self.steps, self.config)

    def _set_conditions(self, sim: Sim, perturbations: Sequence[Perturbation]) -> None:
        friction, mass, inertia = (
            sim.expand(f) for f in ("geom_friction", "body_mass", "body_inertia")
        )
        body = self.hand.object_body
        for row, each in enumerate(perturbations):
            friction[row] *= each.friction * self.config.friction
            mass[row, body] *= each.mass
            inertia[row, body] *= each.mass

    def _close(self, sim: Sim, commands: FloatArray, displaced: FloatArray) -> None:
        """Close a grip by commands (B, 8) around the frozen object, displaced by (B, 3) [m], and
        release the object.
        """
        place, waiting = slice(len(JOINTS), len(JOINTS) + 3), self._waiting[sim.which]
        sim.qpos[:, : len(JOINTS)] = waiting
        sim.qpos[:, place] += displaced
        sim.mocap_pos[:, 0] = sim.qpos[:, place]
        sim.mocap_quat[:, 0] = sim.qpos[:, place.stop :]
        part = np.minimum(1.0, np.arange(1, CLOSING + 1) / RAMP)[:, None]
        sim.play(waiting[:, None] + (commands - waiting)[:, None] * part)
        sim.eq_active[:] = 0

    # A control step

    def measure(self, sim: Sim) -> dict[str, FloatArray]:
        """Normal forces of the contacts (B, 3, C) [N] at the beginning of the last physics step,
        where they act (B, 3, C, 3) [m], the fingertips' positions (B, 3, 3) [m] and axes (B, 3, 9),
        and joint targets (B, 8) [rad].

        `touch.place` puts them into the fingertips' frames, once for all frames of a batch.
        """
        sensors, tips = contact_sensors(sim), self.hand.tip_sites
        return {
            "force": force_of(sensors),
            "contact": sensors[..., 4:7],
            "tip": sim.site_xpos[:, tips],
            "axes": sim.site_xmat[:, tips],
            "target": sim.ctrl,
        }

    def observe(self, sim: Sim) -> FloatArray:
        """The state base's x, (B, d)."""
        state, (angle, place, force) = STATES[self.config.state], self.scales
        joints = self.joints(sim)
        images = points = behind = joints  # unused by a state base without touch
        if state.touch:
            images = self.images(sim)
            points = touch.contact_points(images) * place
            images = images * force
        if self.zeroed:
            behind = sensing.deflections(sim, joints, self.config.stiffness)
        return state.observe(Felt(joints * angle, images, points, behind))

    def joints(self, sim: Sim) -> FloatArray:
        """The joint readings (B, 8) [rad]."""
        return np.asarray(
            sim.qpos[:, : len(JOINTS)] + sim.own["noise"][:, min(sim.t, self.steps - 1)]
        )

    def images(self, sim: Sim) -> FloatArray:
        """What the fingertips read, (B, 3, 18) [N]; to be called once in a control step."""
        images = touch.images(self.measure(sim))
        return sensing.read(sim, images, self.config) if self.config.numb else images

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Joint targets of raw actions (B, 8) [rad], finite."""
        base = {
            "offset": self.start_commands[sim.which],
            "absolute": 0.0,
            "increment": sim.own["target"],
        }[self.action]
        targets = base + action
        if self.zeroed and sim.t < sensing.ZERO:
            targets = sim.own["target"].copy()
        targets[np.isnan(targets)] = 0.0
        low, high = (LOWER, UPPER) if self.clip else (-TARGET_LIMIT, TARGET_LIMIT)
        sim.own["target"] = np.minimum(np.maximum(targets, low), high)
        return sim.own["target"]

    def ended(self, sim: Sim) -> BoolArray:
        """Which rollouts ended because no fingertip touches the object any more."""
        return dropped(sim)

    # Channels

    @cached_property
    def channels(self) -> tuple[Channel, ...]:  # type: ignore[override]  # needs the model's fingertips
        """Touch, forces, contacts, joints."""
        tips = [self.model.geom(geom) for geom in self.hand.tip_geoms]
        bodies = tuple(self.model.body(int(tip.bodyid[0])).name for tip in tips)
        places = np.stack([tip.pos + touch.positions() for tip in tips])
        fingers: dict[str, Any] = {"labels": FINGERS, "colours": _COLOURS, "unit": "N"}
        names = tuple(name.replace("_", " ") for name in JOINTS)
        joints: dict[str, Any] = {"labels": names, "colours": _joint_colours(), "unit": "rad"}
        return (
            Channel(
                name="tactile",
                kind="images",
                shape=(len(FINGERS), *touch.SHAPE),
                top=2.0,
                bodies=bodies,
                places=places,
                trace=True,
                **fingers,
            ),
            Channel(
                name="contacts/force",
                kind="scalars",
                shape=(len(FINGERS),),
                top=3.0,
                geoms=tuple(tip.name for tip in tips),
                **fingers,
            ),
            Channel(
                name="contacts/state",
                kind="flags",
                shape=(len(FINGERS),),
                labels=FINGERS,
                colours=_COLOURS,
            ),
            Channel(
                name="contacts/push",
                kind="arrows",
                shape=(len(FINGERS), 6),
                bodies=bodies,
                length=0.009,
                longest=0.075,
                labels=FINGERS,
                unit="N",
            ),
            Channel(name="joints/position", kind="scalars", shape=(len(JOINTS),), **joints),
            Channel(name="joints/target", kind="scalars", shape=(len(JOINTS),), **joints),
        )

    def show(self, frames: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """The channels' values from measured values."""
        images = touch.images(frames)
        points, force = touch.contact_points(images), images.sum(axis=-1)
        centres = np.stack([self.model.geom_pos[tip] for tip in self.hand.tip_geoms])
        length = np.sqrt((points * points).sum(axis=-1, keepdims=True))
        push = -points / np.where(length > 0, length, 1.0) * force[..., None]
        return {
            "tactile": images.reshape(*images.shape[:-1], *touch.SHAPE),
            "contacts/force": force,
            "contacts/state": (force > 0).astype(float),
            "contacts/push": np.concatenate([centres + points * TIP_RADIUS, push], axis=-1),
            "joints/position": frames["qpos"][..., : len(JOINTS)],
            "joints/target": frames["target"],
        }


def contact_sensors(sim: Sim) -> FloatArray:
    """The contact sensors, (B, 3, C, 7)."""
    values: FloatArray = sim.sensordata.reshape(
        len(sim), len(FINGERS), model.CONTACTS, model.CONTACT_WIDTH
    )
    return values


def force_of(sensors: FloatArray) -> FloatArray:
    """Normal forces, zero where there is no contact, (B, 3, C) [N]."""
    return np.where(sensors[..., 0] > 0, sensors[..., 1], 0.0)


def dropped(sim: Sim) -> BoolArray:
    """Whether no fingertip touches the object in each rollout, (B,)."""
    sensors = contact_sensors(sim)
    return np.asarray(~((sensors[..., 0] > 0) & (sensors[..., 1] > 0)).any(axis=(1, 2)))


def pressing(force: FloatArray) -> BoolArray:
    """Which fingertips press, (..., 3, C) -> (..., 3)."""
    return np.asarray(force.sum(axis=-1) >= PRESSES)


def touching(force: FloatArray) -> BoolArray:
    """Whether any fingertip touches the object, (..., 3, C) -> (...)."""
    return np.asarray((force > 0).any(axis=(-2, -1)))


def moved(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance between poses (..., 7): shift [m] and angle [rad]; for display only: see
    `stayed`.
    """
    shift, cosine = distance(pose, start)
    return shift, 2.0 * np.arccos(np.minimum(cosine, 1.0))


def stayed(pose: FloatArray, start: FloatArray) -> BoolArray:
    """Whether poses (..., 7) are within MAX_SHIFT and MAX_TURN of others; without arccos: equal
    on every processor.
    """
    shift, cosine = distance(pose, start)
    return np.asarray((shift <= MAX_SHIFT) & (cosine >= LEAST_COSINE))


def distance(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shift [m] and the cosine of half the angle between poses (..., 7)."""
    difference = pose[..., :3] - start[..., :3]
    shift = np.sqrt((difference * difference).sum(axis=-1))
    return shift, np.abs((pose[..., 3:] * start[..., 3:]).sum(axis=-1))


def motion(pose: FloatArray, start: FloatArray) -> FloatArray:
    """(shift / MOVED)^2 + (turn / TURNED)^2 between poses (..., 7) in m and wxyz, MOST_MOTION at
    most, (...).
    """
    shift, cosine = distance(pose, start)
    # 1 - cos(turn / 2) grows as the turn's square; arccos would round as the processor likes.
    return np.asarray(
        np.minimum((shift / MOVED) ** 2 + (1.0 - cosine) / (1.0 - TURNED_COSINE), MOST_MOTION)
    )


def _joint_colours() -> tuple[tuple[int, int, int], ...]:
    """A finger's colour in shades from its first joint to its last."""
    out = []
    for name in JOINTS:
        finger, number = name.split("_")
        red, green, blue = (
            min(255, round(c * _SHADES[int(number) - 1])) for c in _COLOURS[FINGERS.index(finger)]
        )
        out.append((red, green, blue))
    return tuple(out)
