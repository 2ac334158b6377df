"""Where pictures are taken from. Pure."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A point of view, as MuJoCo's free camera has it."""

    lookat: tuple[float, float, float]
    """[m]"""
    distance: float
    """[m]"""
    azimuth: float = 120.0
    """[deg]"""
    elevation: float = -15.0
    """[deg]"""
