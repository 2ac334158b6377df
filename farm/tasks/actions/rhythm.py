"""A rhythm of limbs: one oscillator, whose frequency and amplitudes the policy changes in each
step.
"""

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Final

import numpy as np

from farm.arrays import FloatArray
from farm.elementary import cos, sin
from farm.errors import ConfigError
from farm.sim.channels import Quantity
from farm.tasks.actions.offsets import pose
from farm.tasks.actions.space import ActionSpace, actuators, clipped, ranges, unit

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task

GAITS: Final[Mapping[str, tuple[float, ...]]] = {
    "trot": (0.0, 0.5, 0.5, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
    "bound": (0.0, 0.0, 0.5, 0.5),
    "walk": (0.0, 0.5, 0.75, 0.25),
    "alternate": (0.0, 0.5),
}
"""Phases [turns] of front right, front left, rear right and rear left leg; of two legs, if they
alternate.
"""

FREE: Final = "free"
"""The gait whose phases are learnt."""

PHASE: Final = "phase"
"""The oscillator's phase [turns] in `sim.own`, (B,)."""


class Rhythm(ActionSpace):
    """Limbs swing and lift in a rhythm; an action's numbers are its frequency and its amplitudes.

    The policy sees sine and cosine of the phase behind what the task observes, and changes
    frequency and amplitudes in every control step by what it sees. With phase p of a limb, a
    joint's control is

        pose + swing s cos(2 pi p) + lift l max(0, sin(2 pi p)),

    where s and l are the amplitudes' factors. Corrections of each joint come with
    `Residual(Rhythm(...))`.

    Source: policies modulating trajectory generators, Iscen et al. 2018, arXiv:1910.02812.

    Example:
      ```python
      import farm

      LEGS = ("FR", "FL", "RR", "RL")
      LEG = '''<body><joint name="{0}_hip"/><geom size="0.1"/>
        <body><joint name="{0}_knee"/><geom size="0.1"/></body></body>'''
      SERVOS = '''<position name="{0}_hip" joint="{0}_hip" kp="20"/>
        <position name="{0}_knee" joint="{0}_knee" kp="20"/>'''
      BODIES = "".join(LEG.format(leg) for leg in LEGS)
      ACTUATORS = "".join(SERVOS.format(leg) for leg in LEGS)

      class Legs(farm.Task):
          xml = f'''<mujoco><worldbody>{BODIES}</worldbody>
            <actuator>{ACTUATORS}</actuator></mujoco>'''
          actions = farm.Rhythm(LEGS, "trot", swing={"hip": 0.3}, lift={"knee": -0.6})

      assert [each.name for each in Legs().space.quantities] == ["frequency", "swing", "lift"]
      ```
    """

    def __init__(
        self,
        limbs: Sequence[str],
        gait: str | Sequence[float] = "trot",
        *,
        swing: Mapping[str, float],
        lift: Mapping[str, float] | None = None,
        name: str = "{limb}_{joint}",
        frequency: tuple[float, float] = (1.0, 3.0),
        amplitude: tuple[float, float] = (0.0, 2.0),
        pose: str | Sequence[float] = "",
    ) -> None:
        """Say which joints move, and how.

        Args:
          limbs: their names, as in the actuators' names.
          gait: one of GAITS, `free`, or the phase of each limb [turns]. A free gait has another
            number for each limb but the first, its phase from -0.5 to 0.5.
          swing: by joint, how far it swings, in the control's units; negative: the other way.
          lift: by joint, how far it moves while the limb swings forward.
          name: of an actuator.
          frequency: least and most [Hz].
          amplitude: least and most factor of swing and of lift; an action of 0 is in the middle.
          pose: around which joints move, as for `Offsets`.
        """
        self.limbs = tuple(limbs)
        self.gait = gait
        self.swing = dict(swing)
        self.lift = {} if lift is None else dict(lift)
        self.name = name
        self.frequency = frequency
        self.amplitude = amplitude
        self.where = pose

    def fit(self, task: "Task") -> None:
        """Find the joints, and check the numbers."""
        self.period = task.period
        self.middle = pose(task.model, self.where)
        self.low, self.high = ranges(task.model)
        self.free = self.gait == FREE
        self.phases = self._phases()
        for what, ends in (("frequency", self.frequency), ("amplitude", self.amplitude)):
            array = np.asarray(ends, dtype=float)
            if array.shape != (2,) or not 0.0 <= array[0] <= array[1] < math.inf:
                raise ConfigError(
                    f"Rhythm: {what} is {ends!r:.40}; expected two numbers, 0 or more, in order"
                )
        if not self.limbs or len(set(self.limbs)) < len(self.limbs):
            raise ConfigError(
                f"Rhythm: limbs are {', '.join(self.limbs) or 'none'}; expected different names"
            )
        if not self.swing:
            raise ConfigError('Rhythm: swing names no joint; expected one, as in {"hip": 0.3}')
        if self.frequency[1] * self.period >= 0.5:
            most = 0.5 / self.period
            raise ConfigError(
                f"Rhythm: frequency reaches {self.frequency[1]:g} Hz; with control steps of"
                f" {self.period:g} s it must stay below {most:g} Hz"
            )
        names = actuators(task.model)
        self.forth = np.zeros((len(self.limbs), task.model.nu))
        self.up = np.zeros((len(self.limbs), task.model.nu))
        for table, joints in ((self.forth, self.swing), (self.up, self.lift)):
            for i, limb in enumerate(self.limbs):
                for joint, far in joints.items():
                    if not isinstance(far, Real) or not math.isfinite(far):
                        raise ConfigError(
                            f"Rhythm: {joint} moves by {far!r:.40}; expected a finite number"
                        )
                    table[i, self._found(names, limb, joint)] = far
        free = [f"phase {limb}" for limb in self.limbs[1:]] if self.free else []
        self.quantities = unit(["frequency", "swing", "lift", *free])

    def _phases(self) -> FloatArray:
        """The phase of each limb [turns]."""
        if self.free:
            return np.zeros(len(self.limbs))
        if isinstance(self.gait, str) and self.gait not in GAITS:
            raise ConfigError(
                f"Rhythm: gait is {self.gait!r}; expected {', '.join(GAITS)}, {FREE}, or phases"
                " [turns]"
            )
        phases = np.asarray(
            GAITS[self.gait] if isinstance(self.gait, str) else self.gait, dtype=float
        )
        if phases.shape != (len(self.limbs),) or not np.isfinite(phases).all():
            raise ConfigError(
                f"Rhythm: gait {self.gait!r:.40} is for {phases.size} limbs, but there are"
                f" {len(self.limbs)}: {', '.join(self.limbs)}"
            )
        return phases

    def _found(self, names: Sequence[str], limb: str, joint: str) -> int:
        try:
            actuator_name = self.name.format(limb=limb, joint=joint)
        except (KeyError, IndexError, ValueError):
            raise ConfigError(
                f"Rhythm: name is {self.name!r:.60}; expected a text with {{limb}} and {{joint}}"
            ) from None
        if actuator_name not in names:
            raise ConfigError(
                f"Rhythm: no actuator is called {actuator_name!r}; the model has {', '.join(names)}"
            )
        return names.index(actuator_name)

    def begin(self, sim: "Sim") -> None:
        """Begin with phase 0; a task's `reset` may draw another one."""
        sim.own[PHASE] = np.zeros(len(sim))

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls of this step, (B, nu); the phase moves on."""
        part = clipped(action)
        phase = sim.own[PHASE]
        phase += self.period * _between(self.frequency, part[:, 0])
        phase -= np.floor(phase)
        limbs = phase[:, None] + self.phases
        if self.free:
            limbs[:, 1:] += 0.5 * part[:, 3:]
        angle = 2.0 * math.pi * limbs  # (B, limbs)
        forth = _between(self.amplitude, part[:, 1])[:, None] * cos(angle)
        up = _between(self.amplitude, part[:, 2])[:, None] * np.maximum(sin(angle), 0.0)
        out = np.tile(self.middle, (len(sim), 1))
        for i in range(len(self.limbs)):  # in this order, so that sums round alike
            out += forth[:, i : i + 1] * self.forth[i] + up[:, i : i + 1] * self.up[i]
        return np.minimum(np.maximum(out, self.low), self.high)

    def see(self, sim: "Sim", x: FloatArray) -> FloatArray:
        """The observation, and sine and cosine of the phase."""
        angle = 2.0 * math.pi * sim.own[PHASE][:, None]
        return np.concatenate([x, sin(angle), cos(angle)], axis=1)

    def names(self, observations: tuple[Quantity, ...]) -> tuple[Quantity, ...]:
        """The observation's names, and those of sine and cosine."""
        return (*observations, *unit(["phase sine", "phase cosine"]))


def _between(ends: tuple[float, float], part: FloatArray) -> FloatArray:
    """Map numbers (B,) from -1 to 1 to the range between two ends, (B,)."""
    low, high = ends
    return low + (high - low) * (0.5 * (part + 1.0))
