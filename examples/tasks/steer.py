"""An Allegro hand turns a lens or a cube as it is told: either way round, slowly or fast, or not at
all. The hand feels where the lens is, and sees where the cube is.

The speed is observed: it decides how much there is of each wave of the rhythm of `lens.py`. The
search knows one more symmetry at first: who mirrors the hand, so that index and middle finger
change places, sees the object turn the other way.

    farm run --task examples/tasks/steer.py:Lens --algorithm examples/tasks/steer.py:Stages
    farm run --task examples/tasks/steer.py:Cube --algorithm examples/tasks/steer.py:Stages
    farm replay RUN --plan 60 --plan -30 --plan 0 --steps 300 --video steer.gif --speed 1
"""

__neighbours__ = ("lens",)

from dataclasses import dataclass
from typing import Literal

import lens
import numpy as np
from lens import CHANGES, GAINS, ORDERS, WAVES, WIDTHS, varying

import farm
from farm.settings import Texts
from farm.tasks.finger_gait.hand import JOINTS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from farm.tasks.finger_gait.turning import turned

# What is seen, by its number: whether it changes its sign in the mirror
FLIPS = {0: [], 4: [False, True] * 2, 8: [False, True, False, False, True, False, True, False]}
SLOWEST = 0.4  # speed that is drawn for learning, of the largest
STOPS = 0.15  # share of stops among them


class Lens(lens.Lens):
    """Turn a lens as it is told; touch tells where it is."""

    @dataclass(frozen=True, kw_only=True)
    class Config(lens.Lens.Config):
        """The task's settings."""

        wanted: float = farm.setting(60.0, above=0.0, most=360.0)
        """Largest speed that may be told [deg/s]."""
        plan: tuple[float, ...] = ()
        """Speed that is asked for, clockwise [deg/s], repeatable: each for the same share of a
        rollout. By default two that are drawn; from the nominal start the largest, either way
        round.
        """

        def __post_init__(self):
            super().__post_init__()
            if not all(abs(speed) <= self.wanted for speed in self.plan):
                raise farm.ConfigError(
                    f"plan is {' '.join(map(str, self.plan))}; expected speeds from"
                    f" {-self.wanted:g} to {self.wanted:g} deg/s"
                )

    measures = (
        farm.Measure(name="speed_error", low=0.0, high=1000.0, unit="deg/s"),
        farm.Measure(name="turns", low=-1000.0, high=1000.0),
    )

    @property
    def parts(self):
        return (3 * WAVES + 2 * GAINS * WIDTHS[self.config.state],)

    def prepare(self, sim, rngs):
        super().prepare(sim, rngs)
        plan = np.array(self.config.plan) / self.config.wanted
        if plan.size:
            sim.own["plan"] = np.tile(plan, (len(sim), 1))
        else:
            drawn = sim.noise(2, "speed", "uniform", step=0)
            going = np.abs(sim.noise(2, "stop", "uniform", step=0)) >= STOPS
            plan = np.sign(drawn) * (SLOWEST + (1.0 - SLOWEST) * np.abs(drawn)) * going
            nominal = np.array([rng is None for rng in rngs])
            sim.own["plan"] = np.where(nominal[:, None], [1.0, -1.0], plan)
        for name in ("speed", "asked"):  # of late: means of about a cycle
            sim.own[name] = np.zeros(len(sim))
        for name in ("missed", "wished"):  # so far
            sim.own[name] = np.zeros(len(sim))

    def told(self, sim):
        """Speed that is asked for now, 1 for the largest, (B,)."""
        plan = sim.own.get("plan", np.zeros((len(sim), 1)))  # none while the grip is looked for
        return plan[:, min(sim.t * plan.shape[1] // self.steps, plan.shape[1] - 1)]

    def observe(self, sim):
        """The waves times whether the object is to turn, which way, and how fast, (B, 27); and what
        is seen times the first five waves, and these times which way, (B, 10 n).
        """
        sim.own["told"] = self.told(sim)
        told = sim.own["told"][:, None]
        going = np.minimum(1.0, 4.0 * np.abs(told))
        way = np.sign(told) * going
        waves = self.waves(sim)
        seen = self.seen(sim)
        felt = [waves[k] * seen for k in range(GAINS)]
        return np.concatenate(
            [going * waves, way * waves, told * waves, *felt, *(way * each for each in felt)],
            axis=1,
        )

    def measure(self, sim):
        return {**super().measure(sim), "told": sim.own.get("told", self.told(sim))}

    def reward(self, sim, action):
        before = sim.own["turned"]
        terms = super().reward(sim, action)
        now = (sim.own["turned"] - before) / (np.deg2rad(self.config.wanted) * CONTROL_PERIOD)
        # Within a cycle the object turns by jerks, so the mean of about one counts, of both alike
        part = CONTROL_PERIOD / self.config.cycle
        for name, value in (("speed", now), ("asked", sim.own["told"])):
            sim.own[name] = sim.own[name] + part * (value - sim.own[name])
        missed = np.abs(sim.own["speed"] - sim.own["asked"])
        sim.own["missed"] = sim.own["missed"] + missed / self.steps
        sim.own["wished"] = sim.own["wished"] + np.abs(sim.own["asked"]) / self.steps
        return {**terms, "turn": np.maximum(1.0 - missed, -3.0) / self.steps}

    def success(self, sim):
        # Standing still misses all that is wished
        return ~self.ended(sim) & (sim.own["missed"] < 0.05 + 0.25 * sim.own["wished"])

    def outcomes(self, record):
        pose = np.concatenate([record.start["qpos"][:, None], record.frames["qpos"]], axis=1)
        done = np.arange(self.steps) < record.steps[:, None]
        total = np.cumsum(turned(pose[..., len(JOINTS) :]) * done, axis=1)
        told = record.frames["told"]
        changes = np.cumsum(np.diff(told, axis=1, prepend=told[:, :1]) != 0.0, axis=1)
        # Means of a cycle, but for cycles in which it is told something new
        cycle = min(round(self.config.cycle / CONTROL_PERIOD), self.steps - 1)
        speed = (total[:, cycle:] - total[:, :-cycle]) / (cycle * CONTROL_PERIOD)
        steady = (changes[:, cycle:] == changes[:, :-cycle]) & done[:, cycle:]
        error = np.abs(np.rad2deg(speed) - self.config.wanted * told[:, cycle:]) * steady
        count = steady.sum(axis=1)
        # Without such cycles it has followed nothing
        nothing = self.config.wanted * np.abs(told).mean(axis=1)
        return {
            "speed_error": np.where(count > 0, error.sum(axis=1) / np.maximum(count, 1), nothing),
            "turns": total[:, -1] / (2.0 * np.pi),
        }


class Cube(Lens):
    """Turn a cube as told, whose place and tilt are seen."""

    @dataclass(frozen=True, kw_only=True)
    class Config(Lens.Config):
        """The task's settings: what a camera would tell is seen."""

        object: Texts = "cube"
        state: Literal["phase", "joints", "touch", "exact"] = "exact"


def symmetric(width):
    """Which parameters keep the symmetry of `lens.symmetric`, and that of the mirror, (P,)."""
    changes = np.array(CHANGES[width], dtype=int)
    flips = np.array(FLIPS[width], dtype=int)
    felt = [(order + changes) % 2 for order in ORDERS[:GAINS]]
    half = np.concatenate([ORDERS % 2, ORDERS % 2, ORDERS % 2, *felt, *felt])
    none = np.zeros(WAVES, dtype=int)
    mirror = np.concatenate([none, 1 - none, 1 - none, *[flips] * GAINS, *[1 - flips] * GAINS])
    odd = [0, 0, 0, 1, 1, 1]
    # Actions that move the fingers against each other: along x, and upwards
    against = [1, 0, 0, 0, 1, 0]
    return np.concatenate(
        [(half == one) & (mirror == other) for one, other in zip(odd, against, strict=True)]
    )


class Stages(lens.Stages):
    """The two stages of `lens.py`, the first also with the mirror's symmetry."""

    def layout(self, size):
        width = (size // 6 - 3 * WAVES) // (2 * GAINS)
        waves = np.where(ORDERS > 2, 0.5, 1.0)
        each = np.concatenate([waves, waves, waves, np.zeros(2 * GAINS * width)])
        varies = np.concatenate([np.zeros(3 * WAVES, dtype=bool), np.tile(varying(width), 2)])
        return np.tile(each, 6), symmetric(width), np.tile(varies, 6)
