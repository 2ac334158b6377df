"""What MuJoCo warns of while it simulates, although the simulation goes on: kinds, and what to do
about each.
"""

from typing import Final

import mujoco
import numpy as np

from farm.arrays import IntArray

_ARENA: Final = 'give the model more memory: <size memory="50M"/>, or more'
_REMEDIES: Final = {
    "INERTIA": "give small bodies more mass or inertia, or their joints armature",
    "CONTACTFULL": f"contacts are left out; {_ARENA}",
    "CNSTRFULL": f"contacts and limits do not act; {_ARENA}",
    "BADCTRL": (
        "act gave controls that are no numbers or huge, for which MuJoCo took 0; look at act"
    ),
}
KINDS: Final = tuple(_REMEDIES)
"""Names of mjtWarning without mjWARN_.

The others make a simulation unstable, which is reported as such.
"""

_WORDS: Final = {
    "INERTIA": "an inertia matrix is close to singular",
    "CONTACTFULL": "too many contacts for the model's memory",
    "CNSTRFULL": "too many constraints for the model's memory",
    "BADCTRL": "invalid controls",
}
_INDICES: Final = np.array([int(getattr(mujoco.mjtWarning, f"mjWARN_{kind}")) for kind in KINDS])


def chosen(counters: IntArray) -> IntArray:
    """Counters of these kinds, (..., K), among those of all kinds in MuJoCo's order, (..., W)."""
    values: IntArray = counters[..., _INDICES]
    return values


def counters(data: mujoco.MjData) -> IntArray:
    """Number of warnings of each kind in a simulation since it was reset, (K,)."""
    return np.array([data.warning[index].number for index in _INDICES])


def explained(kind: str) -> str:
    """A warning in a line: its kind, what it means and what to do."""
    return f"MuJoCo warns of {_WORDS[kind]} (mjWARN_{kind}): {_REMEDIES[kind]}"
