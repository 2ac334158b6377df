"""An Allegro hand turns a lens round and round, and can feel where it is; or a cube that it sees.

The hand walks on the lens: index and middle finger press from above and are lifted in turn, the
thumb holds it from below. Of this motion nothing is given but a clock and a symmetry: that the
middle finger may do what the index finger did half a cycle before, turned by half a turn about the
vertical. The search `Stages` keeps to it at first, and explores departures from it later.

    farm run --task examples/tasks/lens.py:Lens --algorithm examples/tasks/lens.py:Stages
    farm run --task examples/tasks/lens.py:Cube --algorithm examples/tasks/lens.py:Stages

Rollouts are long because a lens that drifts slowly is lost late.
"""

from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np

import farm
from farm import elementary
from farm.settings import Texts
from farm.tasks.finger_gait import touch
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS
from farm.tasks.finger_gait.holding import (
    CONTROL_PERIOD,
    MAX_SHIFT,
    MAX_TURN,
    HandTask,
    ObjectConfig,
    distance,
    dropped,
)
from farm.tasks.finger_gait.sensing import Perturbation
from farm.tasks.finger_gait.turning import turned, upright
from learner.algorithms.snes import SNES

POSE = slice(len(JOINTS), None)  # of the lens, in qpos
HARMONICS = np.arange(1, 5)  # of the cycle's frequency, in a rhythm
WAVES = 2 * len(HARMONICS) + 1  # a constant, and sine and cosine of each
ORDERS = np.array([0, *np.repeat(HARMONICS, 2)])  # of the waves
GAINS = 5  # of the waves, the first, with which what is seen is multiplied
# What is seen, by its number: whether it changes its sign if all is turned by half a turn
CHANGES = {0: [], 4: [True] * 4, 8: [True] * 4 + [False] * 4}
WIDTHS = {"phase": 0, "joints": 8, "touch": 4, "exact": 4}
PLACE, LEAN = 0.005, 0.1  # a place of 5 mm and a tilt of 0.1 rad count as 1
# Felt directions for these are about 0.08, the sum from above and from below
FELT = 12.5
FAR = 0.01  # an action of 1 moves fingertips by 10 mm
LEVEL = float(elementary.cos(np.array(MAX_TURN)))  # cosine of the tilt of a lost lens
# What is not explored begins with this share of the standard deviation; SNES keeps at least 1e-6
NOTHING = 1e-9


class Lens(HandTask):
    """Turn a lens about the vertical, clockwise seen from above.

    An action moves the targets of the fingertips from where they are in the start grip: index and
    middle finger against each other along x, together upwards, the thumb upwards; then index and
    middle finger together along x, against each other upwards, and the thumb along x. The fingers
    bend in one plane, so nothing moves along y.
    """

    @dataclass(frozen=True, kw_only=True)
    class Config(ObjectConfig):
        """The task's settings."""

        object: Texts = "lens"
        """Object to be turned: the name of a file in assets/objects, or a file NAME.xml of your
        own; of several each rollout has one.
        """
        state: Literal["phase", "joints", "touch", "exact"] = "touch"
        """What is seen: the phase of the cycle alone | with how far the joints are from their
        targets | with what touch tells of the lens's place and tilt | with its true place and tilt.
        """
        cycle: float = farm.setting(1.6, least=0.2, most=100.0)
        """Time of a cycle [s]."""
        wanted: float = farm.setting(60.0, above=0.0, most=360.0)
        """Speed beyond which turning is not rewarded [deg/s]."""
        displacement: float = farm.setting(0.004, least=0.0, most=0.01)
        """A rollout begins with the lens displaced by up to this along each axis [m]."""
        tilt: float = farm.setting(0.05, least=0.0, most=0.3)
        """And tilted by up to this about x and y [rad]."""
        friction: float = farm.setting(1.0, above=0.0)
        """Factor of every friction coefficient."""
        blur: float = farm.setting(0.0, least=0.0, most=10.0)
        """Standard deviation of each number that is seen; 1 is 5 mm, or 0.1 rad."""
        cost: float = farm.setting(0.6, least=0.0)
        """Reward lost in a rollout that is all spent at the largest tilt or shift permitted."""

    pose = "between"
    start_grip = "index+middle+thumb"
    ending = "lost"
    action = "offset"
    steps = 160  # of 0.1 s: ten cycles
    terms = ("turn", "pose", "drop")
    measures = (farm.Measure(name="turns", low=0.0, high=1000.0),)
    actions = tuple(
        farm.Quantity(name, "cm")
        for name in ("apart x", "both z", "thumb z", "both x", "apart z", "thumb x")
    )
    presets = {
        "default": {
            "policy": "linear",
            "bias": False,
            "algorithm": "snes",
            "generations": 180,
            "average": 40,
        }
    }

    @property
    def object(self):
        return self.config.object

    @property
    def parts(self):
        return (WAVES + GAINS * WIDTHS[self.config.state],)

    @property
    def observations(self):
        return ()

    def spec(self):
        return replace(super().spec(), action=len(self.actions))

    def setup(self, sim):
        count = len(self.objects)
        # Of each object: joint angles per metre along x and z, by the smallest motion,
        # J' (J J')^-1; metres along x and z per joint angle; and what is x and y of the world in
        # the fingertips' frames
        self.bend = np.zeros((count, len(JOINTS), len(FINGERS), 2))
        self.moved = np.zeros((count, len(FINGERS), 2, len(JOINTS)))
        self.axes = np.zeros((count, len(FINGERS), 2, 3))
        # What is seen of an object in its nominal place, which counts as zero
        self.sag = np.zeros((count, len(JOINTS)))
        self.zero = np.zeros((count, len(FINGERS), 2))
        super().setup(sim)

    def _demonstrate(self, sim, grip, commands, which):
        felt = super()._demonstrate(sim, grip, commands, which)
        hand = self.hands[which]
        data, jacobian = mujoco.MjData(hand.model), np.empty((3, hand.model.nv))
        data.qpos[: len(JOINTS)] = commands
        mujoco.mj_kinematics(hand.model, data)
        mujoco.mj_comPos(hand.model, data)
        for finger, site in enumerate(hand.tip_sites):
            joints = FINGER_JOINTS[FINGERS[finger]]
            mujoco.mj_jacSite(hand.model, data, jacobian, None, site)
            x, z = jacobian[0, joints], jacobian[2, joints]
            xx = (x * x).sum()
            xz = (x * z).sum()
            zz = (z * z).sum()
            determinant = xx * zz - xz * xz
            self.bend[which, joints, finger, 0] = (zz * x - xz * z) / determinant
            self.bend[which, joints, finger, 1] = (xx * z - xz * x) / determinant
            self.moved[which, finger, 0, joints] = x
            self.moved[which, finger, 1, joints] = z
        self.axes[which] = data.site_xmat[hand.tip_sites].reshape(-1, 3, 3)[:, :2]
        self.sag[which] = sim.qpos[0, : len(JOINTS)] - commands
        points = touch.contact_points(touch.images(self.measure(sim)))
        self.zero[which] = self.ways(points, np.zeros((1, len(JOINTS))), sim.which)[0]
        return felt

    def _drawn(self, rng):
        return Perturbation.draw(
            rng, self.steps, self.config, displacement=self.config.displacement
        )

    def prepare(self, sim, rngs):
        sim.own["leaning"] = self.config.tilt * sim.noise(2, "tilt", "uniform", step=0)
        super().prepare(sim, rngs)
        sim.own["released"] = self.nominal(sim)
        sim.own["felt"] = np.zeros((len(sim), 2, 2))
        sim.own["before"] = sim.qpos[:, POSE].copy()
        sim.own["turned"] = np.zeros(len(sim))

    def _close(self, sim, commands, displaced):
        if "leaning" in sim.own:  # not while the grip is looked for
            half = 0.5 * sim.own["leaning"]
            length = np.sqrt(1.0 + (half * half).sum(axis=1))
            sim.qpos[:, POSE.start + 3] = 1.0 / length
            sim.qpos[:, POSE.start + 4 : POSE.start + 6] = half / length[:, None]
        super()._close(sim, commands, displaced)

    def nominal(self, sim):
        """Poses of the objects in the model, (B, 7)."""
        return np.stack([hand.model.qpos0[POSE] for hand in self.hands])[sim.which]

    def observe(self, sim):
        """The rhythm's waves (B, 9), and what is seen times each of the first five, (B, 5 n)."""
        waves = self.waves(sim)
        x = self.seen(sim)
        return np.concatenate(
            [np.tile(waves, (len(sim), 1)), *(waves[k] * x for k in range(GAINS))], axis=1
        )

    def waves(self, sim):
        """1, and sine and cosine of the cycle's first harmonics, (9,)."""
        angle = 2.0 * np.pi * HARMONICS * (sim.t * CONTROL_PERIOD / self.config.cycle % 1.0)
        waves = np.ones(WAVES)
        waves[1::2] = elementary.sin(angle)
        waves[2::2] = elementary.cos(angle)
        return waves

    def seen(self, sim):
        """What is seen beside the phase, (B, n)."""
        exactly = self.state(sim)
        if not self.config.blur:
            return exactly
        return exactly + self.config.blur * sim.noise(exactly.shape[1], "blur", "normal")

    def state(self, sim):
        """What a state sees without blur, (B, n)."""
        if self.config.state == "phase":
            return np.empty((len(sim), 0))
        if self.config.state == "joints":
            return self.behind(self.deflections(sim), sim.which)
        if self.config.state == "exact":
            w, x, y, z = sim.qpos[:, POSE.start + 3 :].T
            lean = np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x)], axis=1)
            place = sim.qpos[:, POSE][:, :2] - self.nominal(sim)[:, :2]
            return np.concatenate([place / PLACE, lean / LEAN], axis=1)
        above, below = self.directions(sim)
        # A place leans the faces above and below against each other, a tilt in the same way
        return FELT * np.concatenate([above + below, below - above], axis=1)

    def deflections(self, sim):
        """How far the joints' readings are from their targets, less the start grip's, (B, 8)
        [rad].
        """
        return self.joints(sim) - sim.own["target"] - self.sag[sim.which]

    def behind(self, angles, which):
        """Deflections of the joints (B, 8) [rad] with objects (B,) as sums and differences of both
        fingers, (B, 8): first those that change their sign if all is turned by half a turn.
        """
        (ix, iz), (mx, mz), (tx, tz) = (
            [(angles * self.moved[which, finger, axis]).sum(axis=1) / PLACE for axis in range(2)]
            for finger in range(len(FINGERS))
        )
        index, middle = (
            5.0 * (angles[:, joint] + angles[:, joint + 1] + angles[:, joint + 2])
            for joint in (0, 3)
        )
        changing = (ix + mx, iz - mz, index + middle, tx)
        return np.stack([*changing, ix - mx, iz + mz, index - middle, tz], axis=1)

    def directions(self, sim):
        """Where the lens is felt from above and from below: x and y of the directions from the
        fingertips' centres to where they are touched, less those in the start grip, (B, 2) each;
        the last ones while nothing is felt.
        """
        points = touch.contact_points(self.images(sim))
        moved = sim.own["target"] - self.start_commands[sim.which]
        ways = self.ways(points, moved, sim.which) - self.zero[sim.which]
        index, middle, thumb = points.any(axis=-1).T[:, :, None]
        felt = sim.own["felt"]
        both = 0.5 * (ways[:, 0] + ways[:, 1])
        one = np.where(index, ways[:, 0], np.where(middle, ways[:, 1], felt[:, 0]))
        above = np.where(index & middle, both, one)
        below = np.where(thumb, ways[:, 2], felt[:, 1])
        sim.own["felt"] = np.stack([above, below], axis=1)
        return above, below

    def ways(self, points, moved, which):
        """X and y of directions to where fingertips are touched, (B, 3, 2), from these in the
        fingertips' frames (B, 3, 3), how far joint targets have moved (B, 8) [rad], and the objects
        (B,).
        """
        ways = np.empty((len(points), len(FINGERS), 2))
        for finger, name in enumerate(FINGERS):
            bent = sum(moved[:, joint] for joint in FINGER_JOINTS[name])
            x, y, z = points[:, finger].T
            sine, cosine = elementary.sin(bent), elementary.cos(bent)
            # Turned about y, across the finger
            point = (cosine * x + sine * z, y, cosine * z - sine * x)
            for axis in range(2):
                ways[:, finger, axis] = sum(
                    part * other
                    for part, other in zip(point, self.axes[which, finger, axis].T, strict=True)
                )
        return ways

    def act(self, sim, action):
        # From the start grip into the rhythm in half a second
        apart_x, both_z, thumb_z, both_x, apart_z, thumb_x = (
            min(1.0, 0.2 * (sim.t + 1)) * FAR * action
        ).T
        moves = (
            (both_x + apart_x, both_z + apart_z),
            (both_x - apart_x, both_z - apart_z),
            (thumb_x, thumb_z),
        )
        targets = np.zeros((len(sim), len(JOINTS)))
        for finger, move in enumerate(moves):
            for axis in range(2):
                targets += move[axis][:, None] * self.bend[sim.which, :, finger, axis]
        return super().act(sim, targets)

    def reward(self, sim, action):
        pose = sim.qpos[:, POSE]
        turn = turned(np.stack([sim.own["before"], pose], axis=1))[:, 0]
        sim.own["before"] = pose.copy()
        sim.own["turned"] = sim.own["turned"] + turn
        speed = turn / (np.deg2rad(self.config.wanted) * CONTROL_PERIOD)
        shift, _ = distance(pose, sim.own["released"])
        lean = (1.0 - upright(pose)) / (1.0 - LEVEL)
        away = np.minimum((shift / MAX_SHIFT) ** 2 + lean, 2.0)
        lost = self.ended(sim)
        return {
            "turn": np.clip(speed, -3.0, 1.0) / self.steps,
            "pose": -self.config.cost * away / self.steps,
            # In all steps that are left, more than one limit alone costs
            "drop": -1.0 * lost * (self.steps - sim.t) / self.steps,
        }

    def ended(self, sim):
        pose = sim.qpos[:, POSE]
        shift, _ = distance(pose, sim.own["released"])
        return dropped(sim) | (shift > MAX_SHIFT) | (upright(pose) < LEVEL)

    def success(self, sim):
        # A quarter of the wanted turn is more than creeping gives
        least = 0.25 * np.deg2rad(self.config.wanted) * CONTROL_PERIOD * self.steps
        return ~self.ended(sim) & (sim.own["turned"] >= least)

    def outcomes(self, record):
        pose = np.concatenate([record.start["qpos"][:, None], record.frames["qpos"]], axis=1)
        each = turned(pose[..., POSE])
        each[np.arange(self.steps) >= record.steps[:, None]] = 0.0
        return {"turns": np.maximum(each.sum(axis=1) / (2.0 * np.pi), 0.0)}


class Cube(Lens):
    """Turn a cube likewise. Its faces are flat: a fingertip does not feel where their middle is."""

    @dataclass(frozen=True, kw_only=True)
    class Config(Lens.Config):
        """The task's settings: what a camera would tell is seen."""

        object: Texts = "cube"
        state: Literal["phase", "joints", "touch", "exact"] = "exact"


def symmetric(width):
    """Which parameters of a linear policy that sees this many numbers keep the symmetry, (P,): what
    the middle finger does is what the index finger did half a cycle before, turned by half a turn.

    Then the first three actions have the waves of even orders, and what changes its sign by the
    turn times odd ones; the last three have the others.
    """
    changes = np.array(CHANGES[width], dtype=int)
    odd = np.concatenate([ORDERS % 2, *((order + changes) % 2 for order in ORDERS[:GAINS])])
    return np.concatenate([np.tile(odd == 0, 3), np.tile(odd == 1, 3)])


def varying(width):
    """Which of the gains vary with the phase, (5 n,): all but those of the constant wave."""
    return np.arange(GAINS * width) >= width


def rhythm(width):
    """Size of the rhythm's parameters, without feedback: 1, half of it for higher harmonics, and 0
    for all others, (P,).
    """
    size = np.concatenate([np.where(ORDERS > 2, 0.5, 1.0), np.zeros(GAINS * width)])
    return np.tile(size, 6)


@dataclass(frozen=True, kw_only=True)
class Stages(SNES):
    """SNES of a linear policy of `Lens`, in two stages.

    The first keeps the symmetry, and explores rhythms coarsely: such ones do not drift, so that the
    lens is not lost at once. The second explores them finely, and all other parameters, too.
    """

    pairs: int = farm.setting(20, least=1)
    """Pairs of rollouts per generation, N."""
    coarse: int = farm.setting(80, least=0)
    """Generations of the first stage."""
    initial_sigma: float = farm.setting(0.15, above=0.0)
    """First standard deviation of a rhythm [cm]."""
    fine: float = farm.setting(0.03, above=0.0)
    """The same as the second stage begins [cm]."""
    gain: float = farm.setting(0.03, above=0.0)
    """Standard deviation of what is done for 1 that is seen, as each stage begins [cm]."""
    less: float = farm.setting(0.3, above=0.0)
    """Factor for parameters that break the symmetry, in the second stage."""
    symmetry: bool = True
    """The first stage keeps the symmetry."""
    phases: bool = True
    """What is seen is answered differently in each phase of the cycle."""
    learning_rate_sigma: float = farm.setting(0.025, least=0.0)
    """Step size of sigma."""

    def init(self, size):
        return replace(super().init(size), sigma=self._sigma(size, 0))

    def tell(self, state, eps, returns):
        state = super().tell(state, eps, returns)
        if state.generation != self.coarse:
            return state
        return replace(state, sigma=self._sigma(state.mu.size, self.coarse))

    def _sigma(self, size, generation):
        """Standard deviations as a stage begins, (P,)."""
        waves, keeps, varies = self.layout(size)
        first = generation < self.coarse
        sigma = np.where(
            waves > 0.0, (self.initial_sigma if first else self.fine) * waves, self.gain
        )
        if not self.phases:
            sigma = np.where(varies, NOTHING * sigma, sigma)
        if first:
            breaks = NOTHING if self.symmetry else 1.0
        else:
            breaks = self.less
        return sigma * np.where(keeps, 1.0, breaks)

    def layout(self, size):
        """The rhythm's parameters by their size, others 0; which keep the symmetry; and which are
        an answer to what is seen that varies with the phase, (P,).
        """
        width = (size // 6 - WAVES) // GAINS
        varies = np.concatenate([np.zeros(WAVES, dtype=bool), varying(width)])
        return rhythm(width), symmetric(width), np.tile(varies, 6)
