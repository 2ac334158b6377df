"""Whether there is a screen, and drawing without one.

Imports no MuJoCo, which looks at MUJOCO_GL once, when it is imported.
"""

import ctypes.util
import os
import sys


def display() -> bool:
    """Whether a window can be opened; only Linux says."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def draw_offscreen() -> None:
    """Have MuJoCo draw without a window where there is no screen; a MUJOCO_GL of the user's stays as it is."""
    if not display():
        os.environ.setdefault("MUJOCO_GL", "osmesa" if ctypes.util.find_library("OSMesa") else "egl")
