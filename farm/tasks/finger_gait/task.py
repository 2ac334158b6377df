"""Finger gaiting: from one grip of an object to another (Plage 2016, ch. 3).

The hand closes a start grip around a frozen object and releases the object. For `steps` control steps of SUBSTEPS x
TIMESTEP the controller sets joint targets; a demonstration of the goal grip defines the reward.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np

from farm import elementary
from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.settings import setting
from farm.sim.sim import Sim
from farm.tasks.base import Camera, Channel, Record, Score, Task, TaskConfig, TaskSpec
from farm.tasks.finger_gait import model, rewards, touch
from farm.tasks.finger_gait.grasp import Grasping
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS, LOWER, POSES, TIP_RADIUS, UPPER
from farm.tasks.finger_gait.observations import STATES, Felt
from farm.tasks.finger_gait.rewards import REWARDS, TERMS, WEIGHTS

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
"""How far the object's centre may move from its position at the release [m]."""

MAX_TURN: Final = np.deg2rad(30.0)
"""How far the object may turn from its orientation at the release [rad]."""

LEAST_COSINE: Final = float(elementary.cos(np.array(0.5 * MAX_TURN)))
"""Cosine of half of that."""

MOVED: Final = 0.003
"""Shift of the object that costs as much as TURNED [m]."""

TURNED: Final = np.deg2rad(6.0)
"""Turn of the object that costs as much as MOVED [rad]."""

TURNED_COSINE: Final = float(elementary.cos(np.array(0.5 * TURNED)))
"""Cosine of half of that."""

SCALE: Final = (0.8, 1.2)
"""Perturbation: friction and mass are multiplied by U(SCALE)."""

DISPLACEMENT: Final = 0.002
"""Perturbation: the frozen object is displaced by U(-, +) along each axis [m]."""

JOINT_NOISE: Final = 0.01
"""Perturbation: standard deviation of the joint readings [rad]."""

CLOSING: Final = 100
"""Physics steps in which a grip is closed around the frozen object."""

RAMP: Final = 50
"""Physics steps of them in which the commands move from waiting to gripping."""

SETTLE: Final = 50
"""Physics steps from the release of the goal grip until its demonstration is recorded."""

HOLD: Final = 200
"""Physics steps after the release for which a grip must hold the object to be accepted."""

_MOST_MOTION: Final = 20.0  # of the squares of a step: a lost object is punished by other terms
_TARGET_LIMIT: Final = 1e6  # [rad]; keeps an unclipped target in MuJoCo's range
_COLOURS: Final = ((86, 180, 233), (0, 158, 115), (204, 121, 167))  # of the fingers
_SHADES: Final = (1.25, 0.95, 0.65)  # of a finger's joints, first to last


@dataclass(frozen=True, kw_only=True)
class FingerGaitConfig(TaskConfig):
    """The finger gait's settings."""

    gamma: float = setting(0.95, above=0.0, most=1.0)
    """Discount factor of the return, per control step."""
    perturb: bool = False
    """Train on perturbed friction, mass, object position and joint readings (both rollouts of a pair alike)."""
    object: str = "bar"
    """Object to be held: the name of a file in assets/objects, or a file NAME.xml of your own."""
    pose: str = "opposed"
    """How the hand is set up: opposed (thumb opposite the index finger) | between (index and middle finger)."""
    start_grip: str = "index+thumb"
    """Grip in which the object is released."""
    goal_grip: str = "index+middle+thumb"
    """Grip to be reached; its demonstration is recorded from the simulation."""
    friction: float = setting(1.0, above=0.0)
    """Factor of every friction coefficient, of fingertips and object alike."""
    state: str = "joints"
    """State base, the controller's input x: joints | joints+contacts | tactile | joints+tactile | forces | cop."""
    reward: str = "full"
    """Reward: basic (thesis 3.3: joints, action) | full (3.5: tactile image and contact points as well) |
    limited (full, no action punished for more than its joint's range)."""
    weights: str = "projected"
    """Row of the thesis' Table 3.1 with the reward's weights: direct | projected."""
    motion: float = setting(0.0, least=0.0)
    """Penalty per step for moving the object: this factor times the squares of shift / 3 mm and turn / 6 degrees."""
    action: Literal["offset", "absolute", "increment"] = "offset"
    """What an action is [rad]: offset from the start grip's commands, joint position, or change of the last target."""
    clip: bool = True
    """Clip joint targets to the joints' ranges."""
    return_scale: float = setting(rewards.RETURN_SCALE, above=0.0)
    """Factor of the return (thesis 3.4: 0.1, introduced to keep returns small)."""
    joints_scale: float = setting(1.0, above=0.0)
    """Factor of the joint positions [rad] in the state."""
    contacts_scale: float = setting(1.0, above=0.0)
    """Factor of the contact points [fingertip radii] in the state."""
    tactile_scale: float = setting(1.0, above=0.0)
    """Factor of the taxels' forces [N] in the state."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.object.endswith(".xml"):  # so that a run can be repeated from anywhere
            object.__setattr__(self, "object", str(Path(self.object).resolve()))
        for kind, name, known in (
            ("pose", self.pose, POSES),
            ("grip", self.start_grip, GRIPS),
            ("grip", self.goal_grip, GRIPS),
            ("state base", self.state, STATES),
            ("reward", self.reward, REWARDS),
            ("weights", self.weights, WEIGHTS),
        ):
            if name not in known:
                raise ConfigError(f"unknown {kind} {name!r}; known are {', '.join(known)}")
        if self.steps and not SUCCESS_STEPS <= self.steps <= 1000:
            raise ConfigError(f"steps is {self.steps}; expected {SUCCESS_STEPS} to 1000")


@dataclass(frozen=True)
class Perturbation:
    """Perturbed conditions of one rollout, from the freeze on."""

    friction: float
    """Factor of every friction coefficient."""
    mass: float
    """Factor of the object's mass and inertia."""
    displacement: FloatArray
    """Of the frozen object [m], (3,)."""
    noise: FloatArray
    """Added to the joint readings in the state [rad], (T, 8)."""

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        steps: int,
        *,
        friction: tuple[float, float] = SCALE,
        mass: tuple[float, float] = SCALE,
        displacement: float = DISPLACEMENT,
    ) -> "Perturbation":
        """Draw the conditions, always as many numbers and in the same order."""
        return cls(
            friction=float(rng.uniform(*friction)),
            mass=float(rng.uniform(*mass)),
            displacement=rng.uniform(-displacement, displacement, 3),
            noise=rng.normal(0.0, JOINT_NOISE, (steps, len(JOINTS))),
        )

    @classmethod
    def none(cls, steps: int) -> "Perturbation":
        """Nominal conditions."""
        return cls(1.0, 1.0, np.zeros(3), np.zeros((steps, len(JOINTS))))


class FingerGait(Task):
    """An Allegro hand changes from one grip of an object to another."""

    Config = FingerGaitConfig
    steps = 15
    substeps = SUBSTEPS
    ending = "dropped"
    camera = Camera(lookat=(0.035, 0.014, 0.01), distance=0.34, azimuth=150.0, elevation=-14.0)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "perturb": True, "policy": "kernel", "initial_mu": 1.5, "initial_sigma": 0.3, "sigma_rule": "capped",
            "sigma_floor": 0.02, "pairs": 5, "learning_rate_mu": 0.3, "learning_rate_sigma": 0.1, "generations": 90,
        },
        "thesis": {"policy": "projected", "normaliser": "thesis", "sigma_rule": "bare"},
        **{
            name: {
                "perturb": True, "pose": "between", "start_grip": start, "goal_grip": goal, "motion": 0.3,
                "policy": "weighted-kernel", "algorithm": "snes", "pairs": 10, "generations": 25,
            }
            for name, start, goal in (
                ("middle-on", "index+thumb", "index+middle+thumb"),
                ("index-off", "index+middle+thumb", "middle+thumb"),
                ("index-on", "middle+thumb", "index+middle+thumb"),
                ("middle-off", "index+middle+thumb", "index+thumb"),
            )
        },
    }  # fmt: skip
    start_commands: FloatArray
    """Joint targets of the start grip [rad], (8,)."""
    goal: Felt
    """The grip to be reached."""

    def files(self) -> dict[str, str]:
        """Hand, object, and what the task adds."""
        return model.files(self.config.object, self.config.pose)

    def mjcf(self) -> str:
        """One text of them."""
        return model.mjcf(self.sources)

    @cached_property
    def hand(self) -> model.Hand:
        """Indices into the model."""
        return model.Hand(self.model, self.config.object, POSES[self.config.pose])

    @property
    def return_scale(self) -> float:  # type: ignore[override]  # a setting here
        """Factor of the return."""
        return float(self.config.return_scale)

    def spec(self) -> TaskSpec:
        """The task's specification, found without closing a grip."""
        return TaskSpec(
            observation=STATES[self.config.state].size, action=len(JOINTS), steps=self.steps, period=CONTROL_PERIOD,
            terms=(*TERMS, *(["motion"] if self.config.motion else [])), success=True, channels=self.channels,
        )  # fmt: skip

    @property
    def parts(self) -> tuple[int, ...]:  # type: ignore[override]  # a setting's
        """Sizes of the state base's parts."""
        return STATES[self.config.state].sizes

    # Beginning a rollout

    def setup(self, sim: Sim) -> None:
        """Close start and goal grip, and record the demonstration.

        Raises:
          ConfigError: the fingers cannot reach the object, or a grip does not hold it.
        """
        grasping = self._find_start(sim)
        goal = grasping.command(GRIPS[self.config.goal_grip])
        self.goal = self._demonstrate(sim, self.config.goal_grip, goal)

    def _find_start(self, sim: Sim) -> Grasping:
        """Find the commands of the start grip, and check that it holds the object."""
        sim.begin(1)
        self.measure(sim)  # requested before the search for the grip, which would start again otherwise
        grasping = Grasping(self.hand)
        self._waiting = grasping.command(())
        self.start_commands = grasping.command(GRIPS[self.config.start_grip])
        self._demonstrate(sim, self.config.start_grip, self.start_commands)
        return grasping

    def _demonstrate(self, sim: Sim, grip: str, commands: FloatArray) -> Felt:
        """Close a grip, release, let it settle, and record it."""
        sim.begin(1)
        self._close(sim, commands, np.zeros((1, 3)))
        sim.step(SETTLE)
        felt = self.measure(sim)
        joints, images = sim.qpos[0, : len(JOINTS)].copy(), touch.images(felt)
        sim.step(HOLD - SETTLE)
        if not touching(self.measure(sim)["force"])[0]:
            press = self.hand.pose.press
            forces = " and ".join(f"{press[finger]:g} N ({finger})" for finger in GRIPS[grip])
            raise ConfigError(
                f"grip {grip!r} does not hold object {self.hand.object_name!r} in pose {self.config.pose!r}, pressing "
                f"with {forces}; take another grip, pose or object"
            )
        return Felt(joints=joints, images=images[0], points=touch.contact_points(images)[0])

    def prepare(self, sim: Sim, rngs: Sequence[np.random.Generator | None]) -> None:
        """Set friction and mass, close the start grip around the frozen object, and release the object."""
        nominal = Perturbation.none(self.steps)
        drawn = [nominal if rng is None else self._drawn(rng) for rng in rngs]
        if self.config.friction != 1.0 or any(each is not nominal for each in drawn):
            self._set_conditions(sim, drawn)
        self._close(sim, self.start_commands, np.stack([each.displacement for each in drawn]))
        sim.own["noise"] = np.stack([each.noise for each in drawn])
        sim.own["target"] = np.tile(self.start_commands, (len(drawn), 1))
        sim.own["released"] = sim.qpos[:, len(JOINTS) :].copy()

    def _drawn(self, rng: np.random.Generator) -> Perturbation:
        return Perturbation.draw(rng, self.steps)

    def _set_conditions(self, sim: Sim, drawn: Sequence[Perturbation]) -> None:
        friction, mass, inertia = (sim.expand(f) for f in ("geom_friction", "body_mass", "body_inertia"))
        body, own = self.hand.object_body, self.model
        for row, each in enumerate(drawn):
            friction[row] = own.geom_friction * (each.friction * self.config.friction)
            mass[row, body] = own.body_mass[body] * each.mass
            inertia[row, body] = own.body_inertia[body] * each.mass

    def _close(self, sim: Sim, commands: FloatArray, displaced: FloatArray) -> None:
        """Close a grip around the frozen object, displaced by (B, 3) [m], and release the object."""
        place = slice(len(JOINTS), len(JOINTS) + 3)
        sim.qpos[:, : len(JOINTS)] = self._waiting
        sim.qpos[:, place] += displaced
        sim.mocap_pos[:, 0] = sim.qpos[:, place]
        sim.mocap_quat[:, 0] = sim.qpos[:, place.stop :]
        part = np.minimum(1.0, np.arange(1, CLOSING + 1) / RAMP)[:, None]
        sim.play(self._waiting + (commands - self._waiting) * part)
        sim.eq_active[:] = 0

    # A control step

    def measure(self, sim: Sim) -> dict[str, FloatArray]:
        """Normal forces of the contacts (B, 3, C) [N] at the beginning of the last physics step, where they act
        (B, 3, C, 3) [m], the fingertips' positions (B, 3, 3) [m] and axes (B, 3, 9), and joint targets (B, 8) [rad].

        `touch.place` puts them into the fingertips' frames, once for all frames of a batch.
        """  # noqa: D205
        sensors, tips = _sensors(sim), self.hand.tip_sites
        return {
            "force": _force(sensors), "contact": sensors[..., 4:7], "tip": sim.site_xpos[:, tips],
            "axes": sim.site_xmat[:, tips], "target": sim.ctrl,
        }  # fmt: skip

    def observe(self, sim: Sim) -> FloatArray:
        """The state base's x, (B, d)."""
        config, state = self.config, STATES[self.config.state]
        joints = sim.qpos[:, : len(JOINTS)] + sim.own["noise"][:, min(sim.t, self.steps - 1)]
        images = points = joints  # unused by a state base without touch
        if state.touch:
            felt = self.measure(sim)
            images = touch.images(felt)
            points = touch.contact_points(images) * config.contacts_scale
            images = images * config.tactile_scale
        return state.observe(Felt(joints * config.joints_scale, images, points))

    def act(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Joint targets of raw actions (B, 8) [rad], finite."""
        base = {"offset": self.start_commands, "absolute": 0.0, "increment": sim.own["target"]}[self.config.action]
        targets = base + action
        targets[np.isnan(targets)] = 0.0
        low, high = (LOWER, UPPER) if self.config.clip else (-_TARGET_LIMIT, _TARGET_LIMIT)
        sim.own["target"] = np.minimum(np.maximum(targets, low), high)
        return sim.own["target"]

    def ended(self, sim: Sim) -> BoolArray:
        """Which rollouts ended because no fingertip touches the object any more."""
        return _dropped(sim)

    # A chain of gaits

    @property
    def ends(self) -> tuple[str, str]:  # type: ignore[override]  # settings
        """Start and goal grip."""
        return self.config.start_grip, self.config.goal_grip

    def reached(self, sim: Sim) -> BoolArray:
        """Which rollouts have only the goal grip's fingers pressing."""
        return np.asarray((_pressing(_force(_sensors(sim))) == self._wanted).all(axis=-1))

    def lost(self, sim: Sim) -> BoolArray:
        """Which rollouts have dropped the object or moved it too far."""
        return _dropped(sim) | ~stayed(sim.qpos[:, len(JOINTS) :], sim.own["released"])

    @property
    def _wanted(self) -> BoolArray:
        """Which fingers the goal grip has, (3,)."""
        return np.array([finger in GRIPS[self.config.goal_grip] for finger in FINGERS])

    # Whole rollouts

    def score(self, record: Record) -> Score:
        """Reward terms and success of whole rollouts: touch is computed once for all of their steps."""
        force, joints = record.frames["force"], record.frames["qpos"][..., : len(JOINTS)]
        images = touch.images(record.frames)
        felt = Felt(joints, images, touch.contact_points(images))
        dropped = ~record.failed & ~touching(force[np.arange(len(record.steps)), record.steps - 1])
        weights = WEIGHTS[self.config.weights]
        with np.errstate(over="ignore", invalid="ignore"):
            reward = REWARDS[self.config.reward](felt, record.actions, self.goal, weights)
        if self.config.motion:
            reward = np.concatenate([reward, self._motion(record)[..., None]], axis=-1)
        terms = rewards.end(reward, record.steps, dropped, record.failed, weights)
        return Score(terms, ~(dropped | record.failed) & self._success(record))

    def _motion(self, record: Record) -> FloatArray:
        """Penalty for moving the object, (B, T)."""
        pose = slice(len(JOINTS), None)
        shift, cosine = distance(record.frames["qpos"][..., pose], record.start["qpos"][:, None, pose])
        # 1 - cos(turn / 2) grows as the turn's square; arccos would round as the processor likes.
        moved = (shift / MOVED) ** 2 + (1.0 - cosine) / (1.0 - TURNED_COSINE)
        return np.asarray(-self.config.motion * np.minimum(moved, _MOST_MOTION))

    def _success(self, record: Record) -> BoolArray:
        """Whether only the goal grip's fingers press at the last steps, and the object stayed in place."""
        last = slice(-SUCCESS_STEPS, None)
        grips = _pressing(record.frames["force"][:, last]) == self._wanted
        pose = slice(len(JOINTS), None)
        there = stayed(record.frames["qpos"][:, last, pose], record.start["qpos"][:, None, pose])
        return np.asarray(grips.all(axis=(1, 2)) & there.all(axis=1))

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
                name="tactile", kind="images", shape=(len(FINGERS), *touch.SHAPE), top=2.0, bodies=bodies,
                places=places, trace=True, **fingers,
            ),
            Channel(
                name="contacts/force", kind="scalars", shape=(len(FINGERS),), top=3.0,
                geoms=tuple(tip.name for tip in tips), **fingers,
            ),
            Channel(name="contacts/state", kind="flags", shape=(len(FINGERS),), labels=FINGERS, colours=_COLOURS),
            Channel(
                name="contacts/push", kind="arrows", shape=(len(FINGERS), 6), bodies=bodies, length=0.009,
                longest=0.075, labels=FINGERS, unit="N",
            ),
            Channel(name="joints/position", kind="scalars", shape=(len(JOINTS),), **joints),
            Channel(name="joints/target", kind="scalars", shape=(len(JOINTS),), **joints),
        )  # fmt: skip

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

    def exported(self) -> dict[str, Any]:
        """Everything that `observe`, `act` and `score` use."""
        config, goal, weights = self.config, self.goal, WEIGHTS[self.config.weights]
        limits = (LOWER, UPPER) if config.clip else (np.full(8, -_TARGET_LIMIT), np.full(8, _TARGET_LIMIT))
        punished = UPPER - LOWER if config.reward == "limited" else np.full(len(JOINTS), np.inf)
        return {
            "joints": np.array(JOINTS),
            "tips": np.array([f"{finger}_tip" for finger in FINGERS]),
            "action": config.action,
            "lower": limits[0],
            "upper": limits[1],
            "start_command": self.start_commands,
            "input": config.state,
            "joints_scale": config.joints_scale,
            "contacts_scale": config.contacts_scale,
            "tactile_scale": config.tactile_scale,
            "taxels": touch.DIRECTIONS,
            "kappa": touch.KAPPA,
            "weights": rewards.factors(config.reward, weights, goal),
            "punished_to": punished,
            "drop_penalty": weights.drop,
            "motion": config.motion,
            "moved": MOVED,
            "turned_cosine": TURNED_COSINE,
            "most_motion": _MOST_MOTION,
            "goal_joints": goal.joints,
            "goal_images": goal.images,
            "goal_points": goal.points,
        }


def _sensors(sim: Sim) -> FloatArray:
    """The contact sensors, (B, 3, C, 7)."""
    values: FloatArray = sim.sensordata.reshape(len(sim), len(FINGERS), model.CONTACTS, model.CONTACT_WIDTH)
    return values


def _force(sensors: FloatArray) -> FloatArray:
    """Normal forces, zero where there is no contact, (B, 3, C) [N]."""
    return np.where(sensors[..., 0] > 0, sensors[..., 1], 0.0)


def _dropped(sim: Sim) -> BoolArray:
    """In which rollouts no fingertip touches the object, (B,)."""
    sensors = _sensors(sim)
    return np.asarray(~((sensors[..., 0] > 0) & (sensors[..., 1] > 0)).any(axis=(1, 2)))


def _pressing(force: FloatArray) -> BoolArray:
    """Which fingertips press, (..., 3, C) -> (..., 3)."""
    return np.asarray(force.sum(axis=-1) >= PRESSES)


def touching(force: FloatArray) -> BoolArray:
    """Whether any fingertip touches the object, (..., 3, C) -> (...)."""
    return np.asarray((force > 0).any(axis=(-2, -1)))


def moved(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance between poses (..., 7): shift [m] and angle [rad]; for display only: see `stayed`."""
    shift, cosine = distance(pose, start)
    return shift, 2.0 * np.arccos(np.minimum(cosine, 1.0))


def stayed(pose: FloatArray, start: FloatArray) -> BoolArray:
    """Whether poses (..., 7) are within MAX_SHIFT and MAX_TURN of others; without arccos: equal on every processor."""
    shift, cosine = distance(pose, start)
    return np.asarray((shift <= MAX_SHIFT) & (cosine >= LEAST_COSINE))


def distance(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shift [m] and the cosine of half the angle between poses (..., 7)."""
    difference = pose[..., :3] - start[..., :3]
    shift = np.sqrt((difference * difference).sum(axis=-1))
    return shift, np.abs((pose[..., 3:] * start[..., 3:]).sum(axis=-1))


def _joint_colours() -> tuple[tuple[int, int, int], ...]:
    """A finger's colour in shades from its first joint to its last."""
    out = []
    for name in JOINTS:
        finger, number = name.split("_")
        red, green, blue = (min(255, round(c * _SHADES[int(number) - 1])) for c in _COLOURS[FINGERS.index(finger)])
        out.append((red, green, blue))
    return tuple(out)
