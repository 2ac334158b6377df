"""Touch: 18 taxels on the half sphere of each fingertip.

Pure, batched. The fingertip's frame has z along the last link, x to the side that closes on
the object, y across. Its half sphere looks along z turned by TILT towards x, because that is
where a bent finger touches. The taxels lie on it in SHAPE = 6 rows by 3 columns: a row is an
angle in the finger's plane (first row towards the back of the finger, last towards its pad),
a column an angle across (first column at negative y). A contact's normal force is spread over the
taxels by their distance from it, weights exp(KAPPA (cos(angle) - 1)), normalised: the total is
the contact's force (thesis 3.4.3 gives the idea, a decrease with the radius, and no figures).
"""

from typing import Final

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.tasks.finger_gait.hand import TIP_RADIUS

SHAPE: Final = (6, 3)
"""Rows and columns of a fingertip's image."""

TAXELS: Final = SHAPE[0] * SHAPE[1]
"""Taxels a fingertip."""

TILT: Final = np.deg2rad(30.0)
"""Where the middle of the half sphere looks: from the finger's axis towards its pad [rad]."""

ROWS: Final = np.deg2rad([-75.0, -45.0, -15.0, 15.0, 45.0, 75.0])
"""Angles of the rows in the finger's plane, from the middle of the half sphere [rad]."""

COLUMNS: Final = np.deg2rad([-45.0, 0.0, 45.0])
"""Angles of the columns across the finger [rad]."""

KAPPA: Final = 8.0
"""Concentration of the spread; 8 is a Gaussian of about 20 degrees."""


def _directions() -> FloatArray:
    pitch, across = np.meshgrid(ROWS + TILT, COLUMNS, indexing="ij")
    wide, sideways = elementary.cos(across), elementary.sin(across)
    xyz = [wide * elementary.sin(pitch), sideways, wide * elementary.cos(pitch)]
    directions = np.stack(xyz, axis=-1).reshape(TAXELS, 3)
    directions.flags.writeable = False
    return directions


DIRECTIONS: Final = _directions()
"""Unit vectors from the fingertip's centre to its taxels, in its frame, row by row, (18, 3)."""

_AXES: Final = np.ascontiguousarray(DIRECTIONS.T)  # (3, 18)


def positions() -> FloatArray:
    """Places of the taxels in the fingertip's frame [m], (18, 3)."""
    return DIRECTIONS * TIP_RADIUS


def image(force: FloatArray, position: FloatArray) -> FloatArray:
    """Spread contact forces over the taxels.

    Args:
      force: (..., C) normal forces of up to C contacts on a fingertip [N], 0 where there is none.
      position: (..., C, 3) where they act, in the fingertip's frame [m].

    Returns:
      (..., 18) force on each taxel [N]; they add up to the sum of the forces.
    """
    force, position = np.ascontiguousarray(force), np.ascontiguousarray(position)
    images = np.zeros((*force.shape[:-1], TAXELS))
    for contact in range(force.shape[-1]):
        hit = force[..., contact] > 0
        if hit.any():
            images[hit] += _spread(force[..., contact][hit], position[..., contact, :][hit])
    return images


def _spread(force: FloatArray, position: FloatArray) -> FloatArray:
    """One contact a row: force (K,) and place (K, 3) to taxels (K, 18)."""
    x, y, z = position[:, 0], position[:, 1], position[:, 2]
    length = np.sqrt(x * x + y * y + z * z)
    length = np.where(length > 0, length, 1.0)
    # Spelt out, not a matrix product: its sums must not depend on the size of the batch.
    cosine = (
        (x / length)[:, None] * DIRECTIONS[:, 0]
        + (y / length)[:, None] * DIRECTIONS[:, 1]
        + (z / length)[:, None] * DIRECTIONS[:, 2]
    )
    cosine -= 1.0
    cosine *= KAPPA
    weight = elementary.exp(cosine)
    weight *= (force / weight.sum(axis=-1))[:, None]
    return weight


def contact_points(images: FloatArray) -> FloatArray:
    """Centre of force over each fingertip's taxels (thesis 3.5.3).

    Args:
      images: (..., 18) forces [N].

    Returns:
      (..., 3) in the fingertip's frame, in units of its radius; zero without contact.
    """
    images = np.ascontiguousarray(images)  # numpy sums in the order of the memory
    total = images.sum(axis=-1)
    share = images / np.where(total > 0, total, 1.0)[..., None]
    return (share[..., None, :] * _AXES).sum(axis=-1)
