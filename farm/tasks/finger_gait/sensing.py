"""Errors of a hand's sensors and servos, and perturbed conditions.

Errors are of joint and force readings, and stiffness.

Every number is drawn when a rollout begins, always as many and in the same order, so that rollouts
with different errors have the same starts. A nominal rollout has no random errors; delay,
hysteresis and stiffness are properties of the hand.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.settings import setting
from farm.sim.sim import Sim
from farm.tasks.base import TaskConfig
from farm.tasks.finger_gait.hand import FINGERS, JOINTS

SCALE: Final = (0.8, 1.2)
"""Perturbation: friction and mass are multiplied by U(SCALE)."""

DISPLACEMENT: Final = 0.002
"""Perturbation: the frozen object is displaced by U(-, +) along each axis [m]."""

ZERO: Final = 4
"""Control steps in which the state base `zeroed` holds still and averages the servos' deflections.
"""

DEFLECTED: Final = 3.0 / 0.05
"""Force at a lever of 50 mm, about a fingertip's distance from its joints, that deflects a nominal
servo [N/rad].
"""


@dataclass(frozen=True, kw_only=True)
class SensingConfig(TaskConfig):
    """Settings of the hand's sensors and servos."""

    joint_noise: float = setting(0.01, least=0.0, most=1.0)
    """Standard deviation of each joint reading, drawn in each control step [rad]."""
    joint_bias: float = setting(0.0, least=0.0, most=1.0)
    """Joint readings are wrong by U(-joint_bias, joint_bias), drawn for each joint and rollout
    [rad].
    """
    joint_drift: float = setting(0.0, least=0.0, most=1.0)
    """Joint readings drift: standard deviation of a random walk's steps, one per control step
    [rad].
    """
    force_noise: float = setting(0.0, least=0.0, most=100.0)
    """Standard deviation of the total force that a touching fingertip reads, drawn in each control
    step [N].
    """
    force_delay: int = setting(0, least=0, most=100)
    """Force readings are this many control steps old."""
    force_hysteresis: float = setting(0.0, least=0.0, below=1.0)
    """A taxel's reading stays as it is while it is wrong by less than this share of the force."""
    force_dropout: float = setting(0.0, least=0.0, most=1.0)
    """Probability that a fingertip repeats its last reading, for each control step."""
    stiffness: float = setting(1.0, above=0.0, most=10.0)
    """Factor of the stiffness of all servos, nominally 3 N m/rad."""

    @property
    def numb(self) -> bool:
        """Whether force readings have errors."""
        return bool(
            self.force_noise or self.force_delay or self.force_hysteresis or self.force_dropout
        )


@dataclass(frozen=True)
class Perturbation:
    """Perturbed conditions of one rollout, from the freeze on."""

    friction: float
    """Factor of every friction coefficient."""
    mass: float
    """Factor of the object's mass and inertia."""
    displacement: FloatArray
    """Displacement of the frozen object [m], (3,)."""
    noise: FloatArray
    """Added to the joint readings in the state [rad], (T, 8)."""
    force_noise: FloatArray
    """Added to the total force that each touching fingertip reads [N], (T, 3)."""
    lost: BoolArray
    """Which fingertips repeat their last reading, (T, 3)."""

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        steps: int,
        errors: SensingConfig,
        *,
        friction: tuple[float, float] = SCALE,
        mass: tuple[float, float] = SCALE,
        displacement: float = DISPLACEMENT,
    ) -> "Perturbation":
        """Draw the conditions, always as many numbers and in the same order."""
        joints, fingers = (steps, len(JOINTS)), (steps, len(FINGERS))
        factors = float(rng.uniform(*friction)), float(rng.uniform(*mass))
        displaced = rng.uniform(-displacement, displacement, 3)
        noise = rng.normal(0.0, errors.joint_noise, joints)
        noise += rng.uniform(-errors.joint_bias, errors.joint_bias, len(JOINTS))
        noise += np.cumsum(rng.normal(0.0, errors.joint_drift, joints), axis=0)
        force = rng.normal(0.0, errors.force_noise, fingers)
        return cls(*factors, displaced, noise, force, rng.random(fingers) < errors.force_dropout)

    @classmethod
    def none(cls, steps: int) -> "Perturbation":
        """Nominal conditions."""
        fingers = steps, len(FINGERS)
        return cls(
            1.0,
            1.0,
            np.zeros(3),
            np.zeros((steps, len(JOINTS))),
            np.zeros(fingers),
            np.zeros(fingers, bool),
        )


def read(sim: Sim, images: FloatArray, errors: SensingConfig) -> FloatArray:
    """What the fingertips read of true tactile images (B, 3, 18) [N] in this control step; called
    once in each.

    A reading is delayed, then has hysteresis, unless it is lost; noise is added last, in proportion
    to the taxels' readings: a fingertip that touches nothing reads zero.
    """
    now = min(sim.t, sim.own["lost"].shape[1] - 1)
    past = sim.own.get("images", np.repeat(images[:, None], errors.force_delay + 1, axis=1))
    past = np.concatenate([past[:, 1:], images[:, None]], axis=1)
    true, share = past[:, 0], errors.force_hysteresis
    last = sim.own.get("reading", true)
    reading = np.minimum(np.maximum(last, (1.0 - share) * true), (1.0 + share) * true)
    reading = np.where(sim.own["lost"][:, now, :, None], last, reading)
    sim.own["images"], sim.own["reading"] = past, reading
    total = reading.sum(axis=-1, keepdims=True)
    noisy = np.maximum(total + sim.own["force_noise"][:, now, :, None], 0.0)
    return np.asarray(reading * (noisy / np.where(total > 0, total, 1.0)))


def deflections(sim: Sim, joints: FloatArray, stiffness: float) -> FloatArray:
    """How far joint readings (B, 8) are behind their targets, less the mean of this over the first
    ZERO steps.

    A constant error of the readings cancels. As a force [N]: what would deflect the servo so far at
    a lever of 50 mm. Zero in the first steps; called once in each control step.
    """
    behind = sim.own["target"] - joints
    zero = sim.own.get("zero", np.zeros_like(behind))
    if sim.t < ZERO:
        sim.own["zero"] = zero + behind / ZERO
        return np.zeros_like(behind)
    return np.asarray((behind - zero) * (DEFLECTED * stiffness))
