"""Touch: 18 taxels on the half sphere of each fingertip.

Pure functions of batches. The fingertip's frame has z along the last link, x to the side that
closes on the object, y across. Its half sphere looks along z turned by TILT towards x, because that
is where a bent finger touches. The taxels lie on it in SHAPE = 6 rows by 3 columns: a row is an
angle in the finger's plane (first row towards the back of the finger, last towards its pad), a
column an angle across (first column at negative y). A contact's normal force is spread over the
taxels by their distance from it, weights exp(KAPPA (cos(angle) - 1)), normalised: the total is the
contact's force (thesis 3.4.3 describes a decrease with the radius, without figures).
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from farm import elementary
from farm.arrays import FloatArray
from farm.tasks.finger_gait.hand import TIP_RADIUS

SHAPE: Final = (6, 3)
"""Rows and columns of a fingertip's image."""

TAXELS: Final = SHAPE[0] * SHAPE[1]
"""Taxels per fingertip."""

TILT: Final = np.deg2rad(30.0)
"""Direction of the middle of the half sphere: from the finger's axis towards its pad [rad]."""

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


def positions() -> FloatArray:
    """Positions of the taxels in the fingertip's frame [m], (18, 3)."""
    return DIRECTIONS * TIP_RADIUS


def images(frames: Mapping[str, FloatArray]) -> FloatArray:
    """The tactile images of measured values: `force` (..., C) [N] at `contact` (..., C, 3) [m],
    fingertips at `tip` (..., 3) [m] with `axes` (..., 9).

    Returns:
      (..., 18) force on each taxel [N].
    """
    force, place = frames["force"], np.zeros((*frames["force"].shape, 3))
    hit = np.nonzero(force > 0)
    away, axes = frames["contact"][hit] - frames["tip"][hit[:-1]], frames["axes"][hit[:-1]]
    place[hit] = (
        axes[:, 0:3] * away[:, 0:1] + axes[:, 3:6] * away[:, 1:2] + axes[:, 6:9] * away[:, 2:3]
    )
    return image(force, place)


def image(force: FloatArray, position: FloatArray) -> FloatArray:
    """Spread contact forces over the taxels.

    Args:
      force: (..., C) normal forces of up to C contacts on a fingertip [N], 0 for missing contacts.
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
    """One contact per row: force (K,) and position (K, 3) to taxels (K, 18)."""
    x, y, z = np.ascontiguousarray(position.T)
    length = np.sqrt(x * x + y * y + z * z)
    length = np.where(length > 0, length, 1.0)
    # Written out, not a matrix product: the sums must not depend on the size of the batch.
    across, sideways, along = (DIRECTIONS[:, axis, None] for axis in range(3))
    cosine = (x / length) * across + (y / length) * sideways + (z / length) * along
    cosine -= 1.0
    cosine *= KAPPA
    weight = elementary.exp(cosine)
    weight *= force / _total(weight)
    return weight.T


def _total(taxels: FloatArray) -> FloatArray:
    """Sum over taxels (18, ...), always in the same order: faster than numpy's sums of 18 numbers
    each.
    """
    part = taxels[:8] + taxels[8:16]
    part = part[0::2] + part[1::2]
    part = part[0::2] + part[1::2]
    total: FloatArray = part[0] + part[1] + taxels[16] + taxels[17]
    return total


def contact_points(images: FloatArray) -> FloatArray:
    """Centre of force over each fingertip's taxels (thesis 3.5.3).

    Args:
      images: (..., 18) forces [N].

    Returns:
      (..., 3) in the fingertip's frame, in units of its radius; zero without contact.
    """
    taxels = np.ascontiguousarray(images.reshape(-1, TAXELS).T)
    total = _total(taxels)
    taxels /= np.where(total > 0, total, 1.0)
    points = _total(taxels[:, None, :] * DIRECTIONS[..., None])
    return np.ascontiguousarray(points.T).reshape(*images.shape[:-1], 3)
