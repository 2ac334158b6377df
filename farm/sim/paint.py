"""Colours of what a model leaves unpainted: one for each moving body, a light floor with a grid.

They are for pictures alone: no number of a simulation depends on them. A geometry with a material,
or with a colour of its own, keeps it.
"""

import math
from typing import Final

import mujoco
import numpy as np

from farm.arrays import BoolArray, FloatArray

PALETTE: Final = (
    (0, 114, 178),  # blue
    (0, 158, 115),  # bluish green
    (204, 121, 167),  # reddish purple
    (86, 180, 233),  # sky blue
    (213, 94, 0),  # vermillion
    (230, 159, 0),  # orange
    (240, 228, 66),  # yellow
)
"""Colours of bodies, in this order: those of M. Okabe and K. Ito, *Color Universal Design*, 2008,
https://jfly.uni-koeln.de/color, which people with any common colour blindness tell apart.
"""

FLOOR: Final = (0.92, 0.92, 0.9, 1.0)
"""Colour of a floor."""

LINE: Final = (0.62, 0.63, 0.64, 1.0)
"""Colour of a floor's grid."""

UNPAINTED: Final = (0.5, 0.5, 0.5, 1.0)
"""MuJoCo's default colour of a geometry."""

WIDTH: Final = 0.025
"""Width of a line, in spacings."""

_REACH: Final = 60  # lines to each side of a floor's middle, at most
_SPACINGS: Final = (1.0, 2.0, 5.0, 10.0)  # of which a spacing is one, times a power of ten
_FLOORS: Final = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def colours(model: mujoco.MjModel) -> FloatArray:
    """RGBA of each geometry: its own one, or, if it has neither a colour nor a material, its
    body's, (ngeom, 4).
    """
    rgba: FloatArray = np.array(model.geom_rgba, dtype=float)
    bare = _bare(model)
    moving = np.asarray(model.body_weldid)[model.geom_bodyid]  # 0: never
    for number, group in enumerate(np.unique(moving[moving != 0])):
        rgba[bare & (moving == group), :3] = np.array(PALETTE[number % len(PALETTE)]) / 255
    rgba[bare & (moving == 0) & np.isin(model.geom_type, _FLOORS)] = FLOOR
    return rgba


def floors(model: mujoco.MjModel) -> list[int]:
    """Numbers of the fixed planes that have neither a colour nor a material."""
    fixed = np.asarray(model.body_weldid)[model.geom_bodyid] == 0
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return [int(geom) for geom in np.flatnonzero(_bare(model) & fixed & planes)]


def spacing(radius: float) -> float:
    """Distance between a grid's lines beside something of this radius [m]: a little less, 1, 2 or 5
    times a power of ten.
    """
    goal = max(0.8 * radius, 1e-6)
    power = 10.0 ** math.floor(math.log10(goal))
    return power * min(_SPACINGS, key=lambda step: abs(math.log(step * power / goal)))


def grid(
    sides: FloatArray, step: float, about: FloatArray | None = None, reach: int = _REACH
) -> FloatArray:
    """Lines of a grid on a plane, in its own frame [m], (L, 2, 2): the ends of each, x and y.

    Args:
      sides: half the plane's sides (2,) [m]; 0: without end.
      step: between two lines [m].
      about: the place (2,) around which they are [m]; None: the plane's middle.
      reach: number of lines to each side of it, at most.
    """
    middle = np.zeros(2) if about is None else step * np.round(about / step)
    edge = np.where(sides > 0, sides, np.inf)
    low, high = (np.clip(middle + way * reach * step, -edge, edge) for way in (-1, 1))
    if (low >= high).any():  # the plane ends before that place
        return np.empty((0, 2, 2))
    lines = []
    for axis in (0, 1):
        first, last = math.ceil(low[axis] / step - 1e-9), math.floor(high[axis] / step + 1e-9)
        for at in step * np.arange(first, last + 1):
            ends = np.stack([low, high])
            ends[:, axis] = at
            lines.append(ends)
    return np.array(lines).reshape(-1, 2, 2)


def _bare(model: mujoco.MjModel) -> BoolArray:
    """Which geometries have neither a colour nor a material, (ngeom,)."""
    default = np.isclose(model.geom_rgba, UNPAINTED).all(axis=1)
    return np.asarray(default & (model.geom_matid < 0))
