"""The fragile bar: a finger is added to a grip, gently, on a surface of unknown height.

Index finger and thumb grip a bar as in the finger gait, and the middle finger is added. But the bar
under the middle finger is up to 10 mm higher or lower than it appears, and breaks at 3 N: the force
tells when to stop closing. Friction, mass and the bar's position vary more than in the finger gait.
Forces are read with errors. The joint readings have a constant error that is drawn for each
rollout, which hides the servos' deflection from a policy that does not zero its encoders.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Final, Literal

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.settings import setting
from farm.sim.channels import Channel
from farm.sim.sim import Sim
from farm.tasks.base import Record, Score
from farm.tasks.finger_gait.hand import FINGERS, JOINTS
from farm.tasks.finger_gait.holding import (
    LEAST_COSINE,
    MAX_SHIFT,
    PRESSES,
    SUCCESS_STEPS,
    HandTask,
    distance,
    stayed,
)
from farm.tasks.finger_gait.observations import STATES
from farm.tasks.finger_gait.rewards import cut
from farm.tasks.finger_gait.sensing import Perturbation, SensingConfig

TERMS: Final = ("force", "grip", "crush", "pose", "action", "drop")
"""Names of the reward's terms."""

WANTED: Final = 0.9
"""Target force of the middle finger [N]."""

WINDOW: Final = (0.4, 1.4)
"""Range of the middle finger's force that counts as success [N]."""

BREAKS: Final = 3.0
"""Force at which the bar breaks, checked at control steps [N]."""

HEIGHT: Final = 0.01
"""The surface under the middle finger is displaced by U(-, +) [m]."""

_FRICTION: Final = (0.5, 1.5)
_MASS: Final = (0.6, 2.0)
_DISPLACEMENT: Final = 0.003  # [m]
# Penalty for each step after a drop, and the largest one for crush and pose in a step
_WORST: Final = 6.0
_ACTION: Final = 0.2  # penalty per squared change of the targets [1 / rad^2]


@dataclass(frozen=True, kw_only=True)
class FragileBarConfig(SensingConfig):
    """The fragile bar's settings; docs/results/touch.md compares them with others'."""

    gamma: float = setting(1.0, above=0.0, most=1.0)
    """Discount factor of the return, per control step."""
    state: str = "forces"
    """State base, the controller's input x: forces | cop | joints | joints+contacts | tactile |
    joints+tactile | zeroed.
    """
    joint_bias: float = setting(0.05, least=0.0, most=1.0)
    """Joint readings are wrong by U(-joint_bias, joint_bias), drawn for each joint and rollout
    [rad].
    """
    force_noise: float = setting(0.05, least=0.0, most=100.0)
    """Standard deviation of the total force that a touching fingertip reads, drawn in each control
    step [N].
    """
    force_hysteresis: float = setting(0.1, least=0.0, below=1.0)
    """A taxel's reading stays as it is while it is wrong by less than this share of the force."""
    force_dropout: float = setting(0.01, least=0.0, most=1.0)
    """Probability that a fingertip repeats its last reading, for each control step."""
    action: Literal["offset", "absolute", "increment"] = "increment"
    """What an action is [rad]: offset from the start grip's commands, joint position, or change of
    the last target.
    """
    friction: float = setting(1.0, above=0.0)
    """Factor of every friction coefficient, of fingertips and object alike."""

    def __post_init__(self) -> None:
        """Check every value."""
        super().__post_init__()
        if self.state not in STATES:
            raise ConfigError(f"unknown state base {self.state!r}; known are {', '.join(STATES)}")
        if self.steps and not SUCCESS_STEPS <= self.steps <= 1000:
            raise ConfigError(f"steps is {self.steps}; expected {SUCCESS_STEPS} to 1000")


class FragileBar(HandTask):
    """The middle finger joins the grip of a bar whose surface has an unknown height, without
    breaking it.
    """

    Config = FragileBarConfig
    object, pose, start_grip, terms = "fragile-bar", "opposed", "index+thumb", TERMS
    steps = 25
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "policy": "weighted-kernel",
            "width": 0.4,
            "weight_scale": 0.05,
            "algorithm": "snes",
            "pairs": 32,
            "initial_sigma": 0.5,
            "generations": 20,
            "average": 10,
        },
    }

    def prepare(self, sim: Sim, rngs: Sequence[np.random.Generator | None]) -> None:
        """Set conditions and the surface's height, close the start grip round the frozen bar, and
        release it.
        """
        place = sim.expand("geom_pos")
        fragile = self.model.geom("fragile").id
        # Drawn first, so that the other numbers do not depend on how many are drawn here.
        place[:, fragile, 2] = [
            0.0 if rng is None else rng.uniform(-HEIGHT, HEIGHT) for rng in rngs
        ]
        super().prepare(sim, rngs)

    def _drawn(self, rng: np.random.Generator) -> Perturbation:
        wider: dict[str, Any] = {
            "friction": _FRICTION,
            "mass": _MASS,
            "displacement": _DISPLACEMENT,
        }
        return Perturbation.draw(rng, self.steps, self.config, **wider)

    def score(self, record: Record) -> Score:
        """Reward terms, and success: the force is in its range at the last steps, and the bar never
        broke.
        """
        force = record.frames["force"].sum(axis=-1)
        middle = force[..., FINGERS.index("middle")]
        others = np.delete(force, FINGERS.index("middle"), axis=-1)
        pose = slice(len(JOINTS), None)
        shift, cosine = distance(
            record.frames["qpos"][..., pose], record.start["qpos"][:, None, pose]
        )
        change = np.diff(record.frames["target"], axis=1, prepend=record.start["target"][:, None])
        terms = np.stack(
            [
                -np.minimum(np.abs(middle - WANTED) / WANTED, 2.0) - ~_gentle(middle),
                -(others < PRESSES).sum(axis=-1, dtype=float),
                -np.minimum(np.maximum(middle - BREAKS, 0.0), _WORST),
                # 1 - cos(turn / 2) grows as the turn's square; arccos would round as the processor
                # likes.
                -np.minimum(
                    (shift / MAX_SHIFT) ** 2 + (1.0 - cosine) / (1.0 - LEAST_COSINE), _WORST
                ),
                -_ACTION * (change * change).sum(axis=-1),
                np.zeros_like(middle),
            ],
            axis=-1,
        )
        return Score(
            cut(terms, record, _WORST) / self.steps, self._succeeded(record, force, middle)
        )

    def _succeeded(self, record: Record, force: FloatArray, middle: FloatArray) -> BoolArray:
        last, pose = slice(-SUCCESS_STEPS, None), slice(len(JOINTS), None)
        pressed = (force[:, last] >= PRESSES).all(axis=(1, 2))
        still = stayed(
            record.frames["qpos"][:, last, pose], record.start["qpos"][:, None, pose]
        ).all(axis=1)
        whole = (middle <= BREAKS).all(axis=1) & (record.steps == self.steps) & ~record.failed
        return np.asarray(_gentle(middle[:, last]).all(axis=1) & pressed & still & whole)

    @cached_property
    def channels(self) -> tuple[Channel, ...]:  # type: ignore[override]  # as the finger gait's
        """The finger gait's channels, with the range of the middle finger's force that counts as
        success.
        """
        window = {"middle": WINDOW}
        return tuple(
            replace(c, limits=window) if c.name == "contacts/force" else c for c in super().channels
        )


def _gentle(middle: FloatArray) -> BoolArray:
    return np.asarray((middle >= WINDOW[0]) & (middle <= WINDOW[1]))
