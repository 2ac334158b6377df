"""Turning: the hand turns a plate about the vertical by regrasping it, slowly, without flicking it.

Three fingers hold the plate, the thumb from below. The observation is the phase of a cycle and, if
chosen, the joint positions and the fingertips' forces. The reward grows with the speed up to a
wanted one; speed beyond it is penalised.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np

from farm import elementary
from farm.arrays import BoolArray, FloatArray
from farm.settings import setting
from farm.sim.channels import Camera, Quantity
from farm.sim.sim import Sim
from farm.tasks.base import Record, Score
from farm.tasks.finger_gait.hand import FINGERS, JOINTS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD, MAX_SHIFT, MAX_TURN, HandTask, distance
from farm.tasks.finger_gait.rewards import cut
from farm.tasks.finger_gait.sensing import SensingConfig

TERMS: Final = ("turn", "speed", "pose", "action", "drop")
"""Names of the reward terms."""

_HARMONICS: Final = np.arange(1, 4)  # multiples of the cycle's frequency in the observation
# Cosine of the tilt from which the plate is lost
_LEVEL: Final = float(elementary.cos(np.array(MAX_TURN)))
_SIZES: Final = {"phase": 2 * len(_HARMONICS), "joints": len(JOINTS), "forces": len(FINGERS)}
_FORCE: Final = 0.1  # factor of the forces in the observation [1 / N]
_ACTION: Final = 0.02  # reward per squared change of the targets [1 / rad^2]
_POSE: Final = 0.6  # reward lost per step at the largest tilt or shift permitted
_FASTEST: Final = 3.0  # multiple of the wanted speed at which the penalty stops growing


@dataclass(frozen=True, kw_only=True)
class TurningConfig(SensingConfig):
    """Settings of turning."""

    state: Literal["phase", "phase+joints", "phase+forces", "phase+joints+forces"] = "phase+forces"
    """The observation: the phase alone, or also joint positions, fingertip forces, or both."""
    cycle: float = setting(2.0, least=0.2, most=100.0)
    """Time of a cycle [s]."""
    wanted: float = setting(60.0, above=0.0, most=360.0)
    """Wanted speed while the plate turns [deg/s]."""
    friction: float = setting(1.0, above=0.0)
    """Factor of every friction coefficient, of fingertips and object alike."""


class Turning(HandTask):
    """A hand turns a plate by regrasping it."""

    Config = TurningConfig
    object, pose, start_grip, terms = "plate", "between", "index+middle+thumb", TERMS
    action = "offset"
    steps = 80
    ending = "lost"
    camera = Camera(lookat=(0.062, 0.022, 0.022), distance=0.2, azimuth=158.0, elevation=-42.0)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "policy": "linear",
            "algorithm": "snes",
            "pairs": 20,
            "initial_sigma": 0.03,
            "generations": 100,
        },
    }

    @property
    def parts(self) -> tuple[int, ...]:  # type: ignore[override]  # a setting's
        """Sizes of the observation's parts."""
        return tuple(_SIZES[part] for part in self.config.state.split("+"))

    @property
    def observations(self) -> tuple[Quantity, ...]:  # type: ignore[override]  # a setting's
        """Phase, and what the setting says."""
        waves = [f"{wave} {n:g}" for wave in ("sine", "1 - cosine") for n in _HARMONICS]
        names = {"joints": (JOINTS, "rad"), "forces": (FINGERS, f"{1 / _FORCE:g} N")}
        parts = [names[part] for part in self.config.state.split("+") if part in names]
        felt = (Quantity(name, unit) for each, unit in parts for name in each)
        return (*(Quantity(wave) for wave in waves), *felt)

    def observe(self, sim: Sim) -> FloatArray:
        """Phase, joints less the start grip's commands [rad], forces [10 N], (B, d)."""
        # 1 - cosine is zero where a cycle begins, as the sine is: only a policy's offsets change
        # the grip there.
        phase = 2.0 * np.pi * _HARMONICS * (sim.t * CONTROL_PERIOD / self.config.cycle % 1.0)
        parts = [
            np.tile(
                np.concatenate([elementary.sin(phase), 1.0 - elementary.cos(phase)]), (len(sim), 1)
            )
        ]
        if "joints" in self.config.state:
            parts.append(self.joints(sim) - self.start_commands[sim.which])
        if "forces" in self.config.state:
            exact = not self.config.numb
            parts.append(
                _FORCE * (self.measure(sim)["force"] if exact else self.images(sim)).sum(axis=-1)
            )
        return np.concatenate(parts, axis=1)

    def ended(self, sim: Sim) -> BoolArray:
        """Whether the plate is tilted too far, out of place, or touched by no fingertip, (B,)."""
        pose = sim.qpos[:, len(JOINTS) :]
        shift, _ = distance(pose, sim.own["released"])
        return super().ended(sim) | (shift > MAX_SHIFT) | (upright(pose) < _LEVEL)

    def score(self, record: Record) -> Score:
        """Reward terms; success: the plate is still held, and turned at half the wanted speed or
        more on average.
        """
        pose = record.frames["qpos"][..., len(JOINTS) :]
        start = record.start["qpos"][:, None, len(JOINTS) :]
        target = np.deg2rad(self.config.wanted) * CONTROL_PERIOD
        speed = turned(np.concatenate([start, pose], axis=1)) / target
        shift, _ = distance(pose, start)
        change = np.diff(record.frames["target"], axis=1, prepend=record.start["target"][:, None])
        lean = (1.0 - upright(pose)) / (1.0 - _LEVEL)
        terms = np.stack(
            [
                np.maximum(np.minimum(speed, 1.0), -_FASTEST),
                -np.minimum(np.maximum(speed - 1.0, 0.0), _FASTEST),
                -_POSE * np.minimum((shift / MAX_SHIFT) ** 2 + lean, 2.0),
                -_ACTION * (change * change).sum(axis=-1),
                np.zeros_like(speed),
            ],
            axis=-1,
        )
        terms = cut(terms, record, 1.0)
        enough = terms[..., 0].sum(axis=1) >= 0.5 * self.steps
        return Score(terms / self.steps, enough & (record.steps == self.steps) & ~record.failed)


def turned(pose: FloatArray) -> FloatArray:
    """Angles between successive poses (..., T + 1, 7) [rad], clockwise seen from above, (..., T).

    2 tan(angle / 2) instead of the angle: nearly the same where it is small, and arctan rounds as
    the processor likes.
    """
    w, x, y, z = np.moveaxis(pose[..., 3:], -1, 0)
    cosine, sine = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)
    across = sine[..., :-1] * cosine[..., 1:] - cosine[..., :-1] * sine[..., 1:]
    along = cosine[..., :-1] * cosine[..., 1:] + sine[..., :-1] * sine[..., 1:]
    length = np.sqrt(across * across + along * along)
    return np.asarray(2.0 * across / np.maximum(length + along, 1e-9))


def upright(pose: FloatArray) -> FloatArray:
    """Cosine of the tilt of poses (..., 7)."""
    return np.asarray(1.0 - 2.0 * (pose[..., 4] ** 2 + pose[..., 5] ** 2))
