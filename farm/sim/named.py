"""What MuJoCo's arrays hold of one object of the model, found by its name."""

from collections.abc import Callable
from typing import Any, Final

import mujoco
import mujoco.batch
import numpy as np

from farm.arrays import AnyArray
from farm.errors import TaskError

_KINDS: Final = {
    "joint": ("njnt", ""),
    "body": ("nbody", ""),
    "geom": ("ngeom", "geom_"),
    "site": ("nsite", "site_"),
    "sensor": ("nsensor", "sensor"),
    "actuator": ("nu", "actuator_"),
    "tendon": ("ntendon", "ten_"),
}
"""How many there are of each kind, by a field of the model, and how their own fields of MjData
begin.
"""
_NO_PART: Final = ("id", "name", "moment")  # attributes that MuJoCo has, or computes, elsewhere


class Named:
    """An object of the model in all rollouts: `sim.joint("hinge").qpos` is (B, 1), and live as
    `sim.qpos` is.

    It has the attributes of MuJoCo's `data.joint("hinge")`, with B before their shapes.
    """

    id: int
    name: str

    def __init__(
        self, arrays: Callable[[str], AnyArray], data: mujoco.MjData, kind: str, name: str
    ) -> None:
        """Find it.

        Args:
          arrays: gives a field of MjData, (B, ...).
          data: of the model, for addresses.
          kind: one of MuJoCo's: joint, body, ...
          name: its name in the model.

        Raises:
          TaskError: there is none; names those that there are.
        """
        count, prefix = _KINDS[kind]
        try:
            view: Any = getattr(data, kind)(name)
        except (KeyError, IndexError, TypeError):
            each: Any = getattr(data.model, kind)
            names = [each(i).name for i in range(getattr(data.model, count))]
            listing = ", ".join(filter(None, names)) or "none with a name"
            raise TaskError(f"the model has no {kind} {name!r}; it has {listing}") from None
        parts = {
            attribute: _part(data, view, prefix, attribute)
            for attribute in dir(view)
            if attribute[0] != "_"
        }
        vars(self).update(
            id=view.id,
            name=view.name,
            _arrays=arrays,
            _kind=kind,
            _parts={attribute: part for attribute, part in parts.items() if part is not None},
        )

    def __getattr__(self, attribute: str) -> AnyArray:
        """Return the object's part of a field, (B, ...)."""
        parts = vars(self)["_parts"]
        if attribute not in parts:
            raise AttributeError(
                f"a {vars(self)['_kind']} of sim has no {attribute!r}; it has {', '.join(parts)}"
            )
        field, first, shape = parts[attribute]
        rows: AnyArray = vars(self)["_arrays"](field)
        flat = rows.reshape(len(rows), int(np.prod(rows.shape[1:])))
        return flat[:, first : first + int(np.prod(shape))].reshape(len(rows), *shape)

    def same(self, other: "Named") -> bool:
        """Whether another model's object of this name is at the same place of all arrays."""
        return (self.id, vars(self)["_parts"]) == (other.id, vars(other)["_parts"])

    def __setattr__(self, attribute: str, value: object) -> None:
        what = f"sim.{vars(self)['_kind']}({self.name!r}).{attribute}"
        raise AttributeError(f"{what} is written in place: {what}[:] = ...")


def _part(
    data: mujoco.MjData,
    view: Any,  # noqa: ANN401
    prefix: str,
    attribute: str,
) -> tuple[str, int, tuple[int, ...]] | None:
    """The field that has an attribute, where it begins there, and its shape; None if no field has
    it.
    """
    fields = [name for name in (prefix + attribute, attribute) if name in mujoco.batch.DATA_FIELDS]
    if attribute in _NO_PART or not fields:
        return None
    part, whole = getattr(view, attribute), getattr(data, fields[0])
    if not part.size:
        return None
    return fields[0], (part.ctypes.data - whole.ctypes.data) // whole.itemsize, part.shape
