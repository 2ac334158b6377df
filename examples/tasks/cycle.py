"""An Allegro hand changes its grip of a bar again and again, and can feel how the bar creeps."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

import farm
from farm.tasks.finger_gait import touch
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS
from farm.tasks.finger_gait.holding import (
    MOST_MOTION,
    HandTask,
    contact_sensors,
    dropped,
    force_of,
    motion,
    pressing,
    stayed,
)
from farm.tasks.finger_gait.sensing import Perturbation, SensingConfig

CYCLE = ("index+middle+thumb", "middle+thumb", "index+middle+thumb", "index+thumb")
# Which fingers press in each grip, (4, 3)
PRESS = np.array([[finger in GRIPS[grip] for finger in FINGERS] for grip in CYCLE])
POSE = slice(len(JOINTS), None)  # of the object, in qpos
FELT = 3  # control steps for which a grip must be felt before the next one is made
# The pad in a fingertip's x and z: cosine and minus the sine of touch.TILT, 30 degrees
ALONG = (0.75**0.5, -0.5)
# A deflection of 0.2 rad counts as 1, as does a contact 0.2 fingertip radii from the pad's middle
SCALE = 5.0


class Cycle(HandTask):
    """Grip a bar with three fingers, middle finger and thumb, three fingers, index finger and
    thumb, and again.

    Each grip's joint targets are known, and the next grip is made when touch has shown the last
    one. An action is added to the targets: it has to keep the bar in its nominal place, from which
    it creeps with every change. A rollout succeeds if the bar is not lost and at least half of the
    possible changes are made.
    """

    @dataclass(frozen=True, kw_only=True)
    class Config(SensingConfig):
        """The cycle's settings."""

        object: str = "crowned-bar"
        """Object to be held: the name of a file in assets/objects, or a file NAME.xml."""
        state: Literal["phase", "joints", "estimate", "touch"] = "touch"
        """What is seen beside the grip that is being made (phase): each joint's deflection from its
        target | an estimate of the bar's place from these | where the fingertips were last touched,
        as their mean.
        """
        weights: tuple[float, ...] = ()
        """Of the state estimate, for each grip one for each joint's deflection, and a constant
        [fingertip radii].
        """
        friction: float = farm.setting(1.0, above=0.0)
        """Factor of every friction coefficient."""

    pose, start_grip, action, ending = "between", "index+thumb", "absolute", "lost"
    steps = 240  # of 0.1 s: twenty cycles
    # Share of the newest reading in the estimate, which averages over some 20 control steps
    fresh = 0.05
    terms = ("reward",)
    measures = (farm.Measure(name="cycles", low=0.0, high=farm.tasks.base.STEPS_LIMIT),)
    presets = {
        "default": {
            "policy": "linear",
            "bias": False,
            "algorithm": "snes",
            "pairs": 10,
            "initial_sigma": 0.015,
            "generations": 60,
        },
    }

    @property
    def object(self):
        return self.config.object

    @property
    def parts(self):
        width = {"phase": 0, "joints": len(JOINTS), "estimate": 1, "touch": 1}[self.config.state]
        return (len(CYCLE), *[width] * len(CYCLE)) if width else (len(CYCLE),)

    @property
    def observations(self):
        return ()

    def setup(self, sim):
        count = len(CYCLE) * (len(JOINTS) + 1) if self.config.state == "estimate" else 0
        if len(self.config.weights) != count:
            raise farm.ConfigError(
                f"weights has {len(self.config.weights)} numbers; state {self.config.state} needs"
                f" {count}"
            )
        (grasping,) = self._find_start(sim)
        self.commands = np.stack([grasping.command(GRIPS[grip]) for grip in CYCLE])

    def _drawn(self, rng):
        return Perturbation.draw(rng, self.steps, self.config, displacement=0.003)

    def prepare(self, sim, rngs):
        super().prepare(sim, rngs)
        sim.own["changes"], sim.own["felt"] = np.zeros((2, len(sim)), dtype=int)
        sim.own["touched"] = np.zeros((len(sim), len(FINGERS)))
        sim.own["estimate"] = np.zeros(len(sim))

    def observe(self, sim):
        phase = np.eye(len(CYCLE))[sim.own["changes"] % len(CYCLE)]
        # What helps in one phase harms in another, so each has weights of its own
        x = SCALE * self.seen(sim)
        return np.concatenate([phase, *(x * phase[:, [i]] for i in range(len(CYCLE)))], axis=1)

    def seen(self, sim):
        """What a state sees beside the phase, (B, n): deflections [rad], or a place on the pad
        [fingertip radii].
        """
        if self.config.state == "phase":
            return np.empty((len(sim), 0))
        if self.config.state == "joints":
            return self.deflections(sim)
        if self.config.state == "estimate":
            weights = np.reshape(self.config.weights, (len(CYCLE), len(JOINTS) + 1))[
                sim.own["changes"] % len(CYCLE)
            ]
            now = (weights[:, :-1] * self.deflections(sim)).sum(axis=1) + weights[:, -1]
            sim.own["estimate"] += self.fresh * (now - sim.own["estimate"])
            return sim.own["estimate"][:, None].copy()
        points = touch.contact_points(self.images(sim))
        # How far each contact is from the pad's middle, in the finger's plane
        along = ALONG[0] * points[..., 0] + ALONG[1] * points[..., 2]
        sim.own["touched"] = np.where(points.any(axis=-1), along, sim.own["touched"])
        return sim.own["touched"].mean(axis=1, keepdims=True)

    def deflections(self, sim):
        """What the joints' readings are behind their targets, (B, 8) [rad]."""
        return self.joints(sim) - sim.own["target"]

    def act(self, sim, action):
        return super().act(sim, self.commands[sim.own["changes"] % len(CYCLE)] + action)

    def measure(self, sim):  # before `reward`, so that a change in the last step is not counted
        return super().measure(sim) | {
            "changes": sim.own.get("changes", np.zeros(len(sim), dtype=int))
        }

    def reward(self, sim, action):
        force = force_of(contact_sensors(sim))
        pressed = (pressing(force) == PRESS[sim.own["changes"] % len(CYCLE)]).all(axis=1)
        felt = np.where(pressed, sim.own["felt"] + 1, 0)
        changed = felt == FELT
        sim.own["felt"] = np.where(changed, 0, felt)
        sim.own["changes"] = sim.own["changes"] + changed
        stillness = 1.0 - motion(sim.qpos[:, POSE], self.model.qpos0[POSE]) / MOST_MOTION
        return changed * stillness  # nothing for a hand that holds still

    def ended(self, sim):
        return dropped(sim) | ~stayed(sim.qpos[:, POSE], sim.own["released"])

    def success(self, sim):
        return ~self.ended(sim) & (2 * FELT * sim.own["changes"] >= self.steps)

    def outcomes(self, record):
        rows = np.arange(len(record.steps))
        return {"cycles": record.frames["changes"][rows, record.steps - 1] // len(CYCLE)}
