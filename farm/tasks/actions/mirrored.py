"""Limbs that do what those on the other side do."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from farm.arrays import FloatArray
from farm.errors import ConfigError
from farm.tasks.actions.space import ActionSpace, Actuators, Around, listed

if TYPE_CHECKING:
    from farm.sim.sim import Sim
    from farm.tasks.base import Task


class Mirrored(Around):
    """Actuators, or numbers of another action space, that follow their partners on the other side.

    Partners are found by their names: with `{"left": "right"}`, `right_knee` follows `left_knee`.

    Example:
      ```python
      import farm

      class Biped(farm.Task):
          xml = '''<mujoco><worldbody><body><joint name="left_hip"/><geom size="0.1"/></body>
            <body><joint name="right_hip"/><geom size="0.1"/></body></worldbody>
            <actuator><motor joint="left_hip"/><motor joint="right_hip"/></actuator></mujoco>'''
          actions = farm.Mirrored({"left": "right"}, flip=("hip",))  # hips turn the other way

      assert [each.name for each in Biped().space.quantities] == ["left_hip"]
      ```
    """

    def __init__(
        self, sides: Mapping[str, str], flip: Sequence[str] = (), of: ActionSpace | None = None
    ) -> None:
        """Say which names belong together.

        Args:
          sides: parts of names: of those that lead, and of those that follow.
          flip: parts of names of those that follow with the other sign.
          of: the other space; by default the actuators' ranges.
        """
        self.sides = dict(sides)
        self.flip = listed(flip)
        self.of = Actuators() if of is None else of

    def fit(self, task: "Task") -> None:
        """Find the partners."""
        super().fit(task)
        names = [each.name for each in self.of.quantities]
        leads = {}
        for lead, follow in self.sides.items():
            pairs = {name.replace(lead, follow): name for name in names if lead in name}
            missing = [name for name in pairs if name not in names]
            if missing or not pairs:
                what = f"no {missing[0]!r}" if missing else f"nothing with {lead!r} in its name"
                raise ConfigError(f"Mirrored: there is {what}; known are {', '.join(names)}")
            leads |= pairs
            if both := leads.keys() & leads.values():
                raise ConfigError(
                    f"Mirrored: {min(both)!r} would lead and follow; expected sides such as"
                    ' {"left": "right"}'
                )
        for part in self.flip:
            if not any(part in name for name in leads):
                raise ConfigError(f"Mirrored: nothing that follows has {part!r} in its name")
        inputs = [name for name in names if name not in leads]
        self.quantities = tuple(each for each in self.of.quantities if each.name in inputs)
        self.source = np.array([inputs.index(leads.get(name, name)) for name in names])
        flips = [name in leads and any(part in name for part in self.flip) for name in names]
        self.sign = np.where(flips, -1.0, 1.0)

    def controls(self, sim: "Sim", action: FloatArray) -> FloatArray:
        """Controls of the other space, (B, nu)."""
        return self.of.controls(sim, self.sign * action[:, self.source])
