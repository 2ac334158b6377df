"""Finger gaiting: from one grip of an object to another by touch (Plage 2016, ch. 3).

Pure, batched: arrays in, arrays out; the physics is the workers' affair. The hand holds a
released object with the start grip; for `steps` control steps of SUBSTEPS x TIMESTEP the
controller sets joint targets; a demonstration of the goal grip defines the reward.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from farm import elementary, rewards, tactile
from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import ConfigError
from farm.hand import FINGERS, GRIPS, JOINTS, LOWER, UPPER
from farm.rewards import REWARDS, TERMS, WEIGHTS, Demonstration
from farm.states import STATES
from farm.tasks.sizes import Sizes

TIMESTEP: Final = 0.01
"""A physics step [s]."""

SUBSTEPS: Final = 10
"""Physics steps a control step."""

CONTROL_PERIOD: Final = TIMESTEP * SUBSTEPS
"""A control step [s]."""

STEPS: Final = 15
"""Control steps of a rollout, unless told otherwise."""

STEPS_LIMIT: Final = 10_000
"""Control steps of a rollout of an environment, at most."""

PRESSES: Final = 0.1
"""Force from which a fingertip counts as pressing [N]."""

SUCCESS_STEPS: Final = 3
"""Control steps at the end of a rollout over which success is judged."""

MAX_SHIFT: Final = 0.015
"""How far the object's centre may move from where it was released [m]."""

MAX_TURN: Final = np.deg2rad(30.0)
"""How far the object may turn from how it was released [rad]."""

_LEAST_COSINE: Final = float(elementary.cos(np.array(0.5 * MAX_TURN)))  # of half that

SCALE: Final = (0.8, 1.2)
"""Perturbation: friction and mass are multiplied by U(SCALE)."""

DISPLACEMENT: Final = 0.002
"""Perturbation: the frozen object is displaced by U(-, +) along each axis [m]."""

JOINT_NOISE: Final = 0.01
"""Perturbation: standard deviation of the joint readings [rad]."""

_ENVIRONMENT: Final = re.compile(r"([\w.-]{1,60}/)?[\w.-]{1,60}-v\d{1,4}", re.ASCII)
_SHARED: Final = ("task", "steps", "gamma", "perturb")  # settings that other tasks have as well


def _known(kind: str, name: str, known: object) -> None:
    if name not in known:  # type: ignore[operator]
        raise ConfigError(f"unknown {kind} {name!r}; known are {', '.join(known)}")  # type: ignore[call-overload]


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The task."""

    task: str = "finger-gait"
    """One of TASKS: finger-gait, or gym:NAME for a MuJoCo environment of Gymnasium, for example gym:Swimmer-v5."""
    object: str = "bar"
    """Object to be held: the name of a file in assets/objects."""
    start_grip: str = "index+thumb"
    """Grip in which the object is released."""
    goal_grip: str = "index+middle+thumb"
    """Grip to be reached; its demonstration is recorded from the simulation."""
    state: str = "joints"
    """State base, the controller's input x: joints | joints+contacts | tactile | joints+tactile."""
    reward: str = "full"
    """Reward: basic (thesis 3.3: joints, action) | full (3.5: tactile image and contact points as well) |
    limited (full, no action punished for more than its joint's range)."""
    weights: str = "projected"
    """Row of the thesis' Table 3.1 with the reward's weights: direct | projected."""
    steps: int = 0
    """Control steps a rollout; 0: the task's own, 15 (of 0.1 s) or a gym: environment's, which this may shorten."""
    gamma: float = 0.95
    """Discount factor of the return, a control step."""
    return_scale: float = rewards.RETURN_SCALE
    """Factor of the return (thesis 3.4: 0.1, introduced to keep returns small)."""
    perturb: bool = False
    """Train on perturbed friction, mass, object position and joint readings (both rollouts of a pair alike);
    with gym: tasks on starts of many seeds."""
    joints_scale: float = 1.0
    """Factor of the joint positions [rad] in the state."""
    contacts_scale: float = 1.0
    """Factor of the contact points [fingertip radii] in the state."""
    tactile_scale: float = 1.0
    """Factor of the taxels' forces [N] in the state."""

    def __post_init__(self) -> None:
        """Check every value."""
        self._check_task()
        if self.kind == "finger-gait" and self.steps == 0:
            object.__setattr__(self, "steps", STEPS)
        _known("grip", self.start_grip, GRIPS)
        _known("grip", self.goal_grip, GRIPS)
        _known("state base", self.state, STATES)
        _known("reward", self.reward, REWARDS)
        _known("weights", self.weights, WEIGHTS)
        least, most = (SUCCESS_STEPS, 1000) if self.kind == "finger-gait" else (0, STEPS_LIMIT)
        if not isinstance(self.steps, int) or not least <= self.steps <= most:
            raise ConfigError(f"steps is {self.steps}; expected {least} to {most}")
        if not 0 < self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}; expected a number in (0, 1]")
        for name in ("joints_scale", "contacts_scale", "tactile_scale", "return_scale"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ConfigError(f"{name} is {value}; expected a positive number")

    @property
    def kind(self) -> str:
        """The part of the task's name before a colon, by which TASKS knows it."""
        return self.task.partition(":")[0]

    @property
    def environment(self) -> str:
        """The environment's name in Gymnasium's registry."""
        return self.task.partition(":")[2]

    def _check_task(self) -> None:
        """See that the name is one, and that no setting is another task's."""
        from farm.tasks import TASKS  # each of them is told a TaskConfig

        if self.kind == "gym":
            self._check_environment()
        elif self.task not in TASKS:
            known = ", ".join("gym:NAME" if kind == "gym" else kind for kind in TASKS)
            raise ConfigError(f"unknown task {self.task[:80]!r}; known are {known}")
        if self.kind == "finger-gait":
            return
        for f in fields(self):
            if f.name not in _SHARED and getattr(self, f.name) != f.default:
                flag, what = f.name.replace("_", "-"), self.kind + ":" * (self.kind == "gym")
                raise ConfigError(
                    f"--{flag} is a setting of finger-gait; {what} tasks have --steps, --gamma, --perturb"
                )

    def _check_environment(self) -> None:
        """See that the name is one, and nothing that would be imported."""
        if ":" in self.environment:
            raise ConfigError(
                f"task {self.task[:80]!r} names a module to import, which is refused; expected gym:NAME-vN"
            )
        if not _ENVIRONMENT.fullmatch(self.environment):
            raise ConfigError(f"task {self.task[:80]!r} is no environment's name; expected gym:NAME-vN")


@dataclass(frozen=True)
class Perturbation:
    """What is different in one rollout, from the freeze on."""

    friction: float
    """Factor of every friction coefficient."""
    mass: float
    """Factor of the object's mass and inertia."""
    displacement: FloatArray
    """Of the frozen object [m], (3,)."""
    noise: FloatArray
    """Added to the joint readings in the state [rad], (T, 8)."""

    @classmethod
    def draw(cls, rng: np.random.Generator, steps: int) -> "Perturbation":
        """Draw one, always the same numbers in the same order."""
        friction, mass = rng.uniform(*SCALE, 2)
        return cls(
            friction=float(friction),
            mass=float(mass),
            displacement=rng.uniform(-DISPLACEMENT, DISPLACEMENT, 3),
            noise=rng.normal(0.0, JOINT_NOISE, (steps, len(JOINTS))),
        )


@dataclass(frozen=True)
class Frames:
    """What the simulator measured, any leading shape (...)."""

    qpos: FloatArray
    """(..., 15): joint positions [rad], then the object's position [m] and quaternion wxyz."""
    force: FloatArray
    """(..., 3, C) normal force of each contact of each fingertip with the object [N]."""
    place: FloatArray
    """(..., 3, C, 3) where it acts, in the fingertip's frame [m]."""

    def at(self, rows: Sequence[int] | IntArray) -> "Frames":
        """Some of them, by their first axis."""
        return Frames(self.qpos[rows], self.force[rows], self.place[rows])

    @property
    def joints(self) -> FloatArray:
        """(..., 8) [rad]."""
        return self.qpos[..., : len(JOINTS)]

    @property
    def pose(self) -> FloatArray:
        """The object's (..., 7)."""
        return self.qpos[..., len(JOINTS) :]


@dataclass(frozen=True)
class Outcome:
    """What rollouts were worth."""

    returns: FloatArray
    """(B,)"""
    success: BoolArray
    """(B,)"""
    steps: IntArray
    """(B,) control steps until the end, the last one included."""
    dropped: BoolArray
    """(B,) ended because no fingertip touched the object."""
    failed: BoolArray
    """(B,) ended because the physics blew up."""
    clamped: BoolArray
    """(B,) the return overflowed."""
    images: FloatArray
    """(B, T, 3, 18) [N], zero after the end."""
    points: FloatArray
    """(B, T, 3, 3) [radii], zero after the end."""
    terms: FloatArray
    """(B, T, 5), zero after the end."""


def sizes(config: TaskConfig) -> Sizes:
    """How large the task's numbers are."""
    return Sizes(
        observation=STATES[config.state].size, lower=LOWER, upper=UPPER, steps=config.steps, period=CONTROL_PERIOD,
        terms=TERMS, joints=len(JOINTS), fingers=len(FINGERS), success=True,
    )  # fmt: skip


class FingerGait:
    """Observation, reward and success of the task."""

    def __init__(self, config: TaskConfig, goal: Demonstration, commands: FloatArray) -> None:
        """Take the demonstration of the goal grip and the start grip's commands (8,) [rad]."""
        self.config = config
        self.goal = goal
        self.commands = commands
        self.state = STATES[config.state]
        self._scales = (config.joints_scale, config.tactile_scale, config.contacts_scale)

    def observe(self, frames: Frames, noise: FloatArray | None) -> FloatArray:
        """The controller's input.

        Args:
          frames: one moment of B rollouts.
          noise: (B, 8) added to the joint readings [rad], or None.

        Returns:
          (B, d).
        """
        joints = frames.joints if noise is None else frames.joints + noise
        images = points = joints  # not looked at by a state base without touch
        if self.state.touch:
            images = tactile.image(frames.force, frames.place)
            points = tactile.contact_points(images) * self._scales[2]
            images = images * self._scales[1]
        return self.state.observe(joints * self._scales[0], images, points)

    def judge(
        self, frames: Frames, actions: FloatArray, start: FloatArray, steps: IntArray, failed: BoolArray
    ) -> Outcome:
        """Rewards, returns and success of rollouts that are over.

        Args:
          frames: (B, T) moments after each control step, zero after the end.
          actions: (B, T, 8) raw actions, zero after the end.
          start: (B, 7) pose of the object at release.
          steps: (B,) control steps each lasted.
          failed: (B,) whether the physics blew up in the last of them.
        """
        images = tactile.image(frames.force, frames.place)
        points = tactile.contact_points(images)
        dropped = ~failed & ~touching(frames.force[np.arange(len(steps)), steps - 1])
        weights = WEIGHTS[self.config.weights]
        with np.errstate(over="ignore", invalid="ignore"):
            reward = REWARDS[self.config.reward](frames.joints, images, points, actions, self.goal, weights)
        terms = rewards.end(reward, steps, dropped, failed, weights)
        returns, clamped = rewards.discounted(terms, self.config.gamma, self.config.return_scale)
        ended = dropped | failed
        return Outcome(
            returns=returns,
            success=~ended & self._success(frames, start),
            steps=steps,
            dropped=dropped,
            failed=failed,
            clamped=clamped,
            images=images,
            points=points,
            terms=terms,
        )

    def _success(self, frames: Frames, start: FloatArray) -> BoolArray:
        """Whether the goal grip's fingers, no others, press at the last steps and the object stayed where it was."""
        wanted = np.array([finger in GRIPS[self.config.goal_grip] for finger in FINGERS])
        last = slice(-SUCCESS_STEPS, None)
        grips = (frames.force[:, last].sum(axis=-1) >= PRESSES) == wanted
        return np.asarray(grips.all(axis=(1, 2)) & stayed(frames.pose[:, last], start[:, None]).all(axis=1))


def touching(force: FloatArray) -> BoolArray:
    """Whether any fingertip touches the object, (..., 3, C) -> (...)."""
    return np.asarray((force > 0).any(axis=(-2, -1)))


def moved(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far poses (..., 7) are from others: shift [m] and angle [rad], to be read, not to decide: see `stayed`."""
    shift, cosine = _distance(pose, start)
    return shift, 2.0 * np.arccos(np.minimum(cosine, 1.0))


def stayed(pose: FloatArray, start: FloatArray) -> BoolArray:
    """Whether poses (..., 7) are within MAX_SHIFT and MAX_TURN of others, the same on every processor: no arccos."""
    shift, cosine = _distance(pose, start)
    return np.asarray((shift <= MAX_SHIFT) & (cosine >= _LEAST_COSINE))


def _distance(pose: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Shift [m] and the cosine of half the angle between poses (..., 7)."""
    difference = pose[..., :3] - start[..., :3]
    shift = np.sqrt((difference * difference).sum(axis=-1))
    return shift, np.abs((pose[..., 3:] * start[..., 3:]).sum(axis=-1))
