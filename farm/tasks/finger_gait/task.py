"""Finger gaiting: from one grip of an object to another (Plage 2016, ch. 3).

The hand closes a start grip around a frozen object and releases the object. For `steps` control
steps of SUBSTEPS x TIMESTEP the controller sets joint targets; a demonstration of the goal grip
defines the reward.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from farm.arrays import BoolArray, FloatArray
from farm.errors import ConfigError
from farm.settings import Texts, setting
from farm.sim.model_files import Files
from farm.sim.sim import Sim
from farm.tasks.base import Record, Score
from farm.tasks.finger_gait import rewards, touch
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS, LOWER, POSES, UPPER
from farm.tasks.finger_gait.holding import (
    MOST_MOTION,
    MOVED,
    SUCCESS_STEPS,
    TARGET_LIMIT,
    TURNED_COSINE,
    HandTask,
    ObjectConfig,
    contact_sensors,
    dropped,
    force_of,
    motion,
    pressing,
    stayed,
    touching,
)
from farm.tasks.finger_gait.observations import STATES, Felt
from farm.tasks.finger_gait.rewards import REWARDS, TERMS, WEIGHTS
from farm.tasks.finger_gait.sensing import DEFLECTED, ZERO


@dataclass(frozen=True, kw_only=True)
class FingerGaitConfig(ObjectConfig):
    """The finger gait's settings."""

    gamma: float = setting(0.95, above=0.0, most=1.0)
    """Discount factor of the return, per control step."""
    perturb: bool = False
    """Train on perturbed friction, mass, object position and joint readings (both rollouts of a
    pair alike).
    """
    object: Texts = setting("bar")
    """Object to be held: the name of a file in assets/objects, or a file NAME.xml of your own;
    of several each rollout has one.
    """
    pose: str = "opposed"
    """How the hand is set up: opposed (thumb opposite the index finger) | between (index and middle
    finger).
    """
    start_grip: str = "index+thumb"
    """Grip in which the object is released."""
    goal_grip: str = "index+middle+thumb"
    """Grip to be reached; its demonstration is recorded from the simulation."""
    friction: float = setting(1.0, above=0.0)
    """Factor of every friction coefficient, of fingertips and object alike."""
    state: str = "joints"
    """State base, the controller's input x: joints | joints+contacts | tactile | joints+tactile |
    forces | cop | zeroed.
    """
    reward: str = "full"
    """Reward: basic (thesis 3.3: joints, action) | full (3.5: tactile image and contact points as
    well) | limited (full, no action punished for more than its joint's range).
    """
    weights: str = "projected"
    """Row of the thesis' Table 3.1 with the reward's weights: direct | projected."""
    motion: float = setting(0.0, least=0.0)
    """Penalty per step for moving the object: this factor times the squares of shift / 3 mm and
    turn / 6 degrees.
    """
    action: Literal["offset", "absolute", "increment"] = "offset"
    """What an action is [rad]: offset from the start grip's commands, joint position, or change of
    the last target.
    """
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
        for kind, name, options in (
            ("pose", self.pose, POSES),
            ("grip", self.start_grip, GRIPS),
            ("grip", self.goal_grip, GRIPS),
            ("state base", self.state, STATES),
            ("reward", self.reward, REWARDS),
            ("weights", self.weights, WEIGHTS),
        ):
            if name not in options:
                raise ConfigError(f"unknown {kind} {name!r}; known are {', '.join(options)}")
        if self.steps and not SUCCESS_STEPS <= self.steps <= 1000:
            raise ConfigError(f"steps is {self.steps}; expected {SUCCESS_STEPS} to 1000")


class FingerGait(HandTask):
    """An Allegro hand changes from one grip of an object to another."""

    Config = FingerGaitConfig
    steps = 15
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "default": {
            "perturb": True,
            "policy": "kernel",
            "initial_mu": 1.5,
            "initial_sigma": 0.3,
            "sigma_rule": "capped",
            "sigma_floor": 0.02,
            "pairs": 5,
            "learning_rate_mu": 0.3,
            "learning_rate_sigma": 0.1,
            "generations": 90,
        },
        "thesis": {"policy": "projected", "normaliser": "thesis", "sigma_rule": "bare"},
        **{
            name: {
                "perturb": True,
                "pose": "between",
                "start_grip": start,
                "goal_grip": goal,
                "motion": 0.3,
                "policy": "weighted-kernel",
                "algorithm": "snes",
                "pairs": 10,
                "generations": 25,
            }
            for name, start, goal in (
                ("middle-on", "index+thumb", "index+middle+thumb"),
                ("index-off", "index+middle+thumb", "middle+thumb"),
                ("index-on", "middle+thumb", "index+middle+thumb"),
                ("middle-off", "index+middle+thumb", "index+thumb"),
            )
        },
    }
    goals: Sequence[Felt]
    """The grip to be reached, of each object."""

    def __init__(self, config: Any = None, variant: str = "", files: Files | None = None) -> None:  # noqa: ANN401
        """Take what the settings say of object, hand and grip."""
        settings: Any = self.Config() if config is None else config
        self.pose, self.start_grip, self.clip = settings.pose, settings.start_grip, settings.clip
        self.scales = settings.joints_scale, settings.contacts_scale, settings.tactile_scale
        self.terms = (*TERMS, *(["motion"] if settings.motion else []))
        super().__init__(settings, variant, files)

    @property
    def object(self) -> Texts:  # type: ignore[override]  # a setting here
        """The object, or objects."""
        return self.config.object  # type: ignore[no-any-return]

    @property
    def return_scale(self) -> float:  # type: ignore[override]  # a setting here
        """Factor of the return."""
        return float(self.config.return_scale)

    # Beginning a rollout

    def setup(self, sim: Sim) -> None:
        """Close start and goal grip, and record the demonstration.

        Raises:
          ConfigError: the fingers cannot reach an object, or a grip does not hold it.
        """
        grip, starts = self.config.goal_grip, enumerate(self._find_start(sim))
        self.goals = [
            self._demonstrate(sim, grip, each.command(GRIPS[grip]), which) for which, each in starts
        ]

    # A chain of gaits

    @property
    def ends(self) -> tuple[str, str]:  # type: ignore[override]  # settings
        """Start and goal grip."""
        return self.config.start_grip, self.config.goal_grip

    def reached(self, sim: Sim) -> BoolArray:
        """Which rollouts have only the goal grip's fingers pressing."""
        return np.asarray((pressing(force_of(contact_sensors(sim))) == self._wanted).all(axis=-1))

    def lost(self, sim: Sim) -> BoolArray:
        """Which rollouts have dropped the object or moved it too far."""
        return dropped(sim) | ~stayed(sim.qpos[:, len(JOINTS) :], sim.own["released"])

    @property
    def _wanted(self) -> BoolArray:
        """Which fingers the goal grip has, (3,)."""
        return np.array([finger in GRIPS[self.config.goal_grip] for finger in FINGERS])

    # Whole rollouts

    def score(self, record: Record) -> Score:
        """Reward terms and success of whole rollouts: touch is computed once for all of their
        steps.
        """
        force, joints = record.frames["force"], record.frames["qpos"][..., : len(JOINTS)]
        images = touch.images(record.frames)
        felt = Felt(joints, images, touch.contact_points(images))
        fell = ~record.failed & ~touching(force[np.arange(len(record.steps)), record.steps - 1])
        weights = WEIGHTS[self.config.weights]
        with np.errstate(over="ignore", invalid="ignore"):
            reward = self._rewarded(felt, record)
        if self.config.motion:
            reward = np.concatenate([reward, self._motion(record)[..., None]], axis=-1)
        terms = rewards.end(reward, record.steps, fell, record.failed, weights)
        return Score(terms, ~(fell | record.failed) & self._success(record))

    def _rewarded(self, felt: Felt, record: Record) -> FloatArray:
        """The reward's terms, by the demonstration with each rollout's object, (B, T, 5)."""
        call, weights = REWARDS[self.config.reward], WEIGHTS[self.config.weights]
        if len(self.goals) == 1:
            return call(felt, record.actions, self.goals[0], weights)
        terms = np.empty((*record.actions.shape[:2], len(TERMS)))
        for which in np.unique(record.which).tolist():
            its, goal = record.which == which, self.goals[which]
            part = Felt(felt.joints[its], felt.images[its], felt.points[its])
            terms[its] = call(part, record.actions[its], goal, weights)
        return terms

    def _motion(self, record: Record) -> FloatArray:
        """Penalty for moving the object, (B, T)."""
        pose = slice(len(JOINTS), None)
        return -self.config.motion * motion(
            record.frames["qpos"][..., pose], record.start["qpos"][:, None, pose]
        )

    def _success(self, record: Record) -> BoolArray:
        """Whether only the goal grip's fingers press at the last steps, and the object stayed in
        place.
        """
        last = slice(-SUCCESS_STEPS, None)
        grips = pressing(record.frames["force"][:, last]) == self._wanted
        pose = slice(len(JOINTS), None)
        still = stayed(record.frames["qpos"][:, last, pose], record.start["qpos"][:, None, pose])
        return np.asarray(grips.all(axis=(1, 2)) & still.all(axis=1))

    def exported(self) -> dict[str, Any]:
        """Everything that `observe`, `act` and `score` use, with the first object."""
        config, goal, weights = self.config, self.goals[0], WEIGHTS[self.config.weights]
        limits = (
            (LOWER, UPPER) if config.clip else (np.full(8, -TARGET_LIMIT), np.full(8, TARGET_LIMIT))
        )
        punished = UPPER - LOWER if config.reward == "limited" else np.full(len(JOINTS), np.inf)
        return {
            "joints": np.array(JOINTS),
            "tips": np.array([f"{finger}_tip" for finger in FINGERS]),
            "action": config.action,
            "lower": limits[0],
            "upper": limits[1],
            "start_command": self.start_commands[0],
            "input": config.state,
            "joints_scale": config.joints_scale,
            "contacts_scale": config.contacts_scale,
            "tactile_scale": config.tactile_scale,
            "zero_steps": ZERO if self.zeroed else 0,
            "deflection_scale": DEFLECTED * config.stiffness,
            "taxels": touch.DIRECTIONS,
            "kappa": touch.KAPPA,
            "weights": rewards.factors(config.reward, weights, goal),
            "punished_to": punished,
            "drop_penalty": weights.drop,
            "motion": config.motion,
            "moved": MOVED,
            "turned_cosine": TURNED_COSINE,
            "most_motion": MOST_MOTION,
            "goal_joints": goal.joints,
            "goal_images": goal.images,
            "goal_points": goal.points,
        }
