"""Running mean and standard deviation of observations: of one rollout, merged over many, and for
policies.

Pure.

Moments of N observations (d,) are one row of 1 + 2 d numbers: N, their mean, and the sums of their
squared deviations from it (M2). A row of zeros means no observations. All operations are
elementwise and in a fixed order, so the same observations give the same bits.
"""

from typing import Final

import numpy as np

from farm.arrays import FloatArray, IntArray

_FLAT: Final = 1e-8  # a standard deviation below this counts as zero


class Moments:
    """Moments of the observations of B rollouts, updated in every step (Welford 1962)."""

    def __init__(self, rollouts: int, size: int) -> None:
        """Start without observations.

        Args:
          rollouts: number of rollouts, B.
          size: size of an observation, d.
        """
        self.table = np.zeros((rollouts, 1 + 2 * size))
        """(B, 1 + 2 d)"""
        self._size = size

    def add(self, rows: slice | IntArray, x: FloatArray) -> None:
        """Add an observation (n, d) to each of some rollouts (n,) or of all."""
        table, mean, squares = self.table, slice(1, 1 + self._size), slice(1 + self._size, None)
        # `usable` and `merged` leave out values that are not finite
        with np.errstate(over="ignore", invalid="ignore"):
            table[rows, 0] += 1.0
            difference = x - table[rows, mean]
            table[rows, mean] += difference / table[rows, :1]
            table[rows, squares] += difference * (x - table[rows, mean])


def usable(table: FloatArray) -> FloatArray:
    """Moments (B, 1 + 2 d), with zeros in place of rows that are not finite."""
    return np.where(np.isfinite(table).all(axis=1, keepdims=True), table, 0.0)


def merged(total: FloatArray, table: FloatArray) -> FloatArray:
    """Moments (1 + 2 d,) of all observations of `total` and, row by row in order, of a table (B, 1
    + 2 d).

    Chan, Golub & LeVeque 1979, Updating formulae and a pairwise algorithm for computing sample
    variances. A row that would make the result non-finite is left out.
    """
    size = len(total) // 2
    for row in table:
        count = total[0] + row[0]
        if row[0] == 0.0:
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            difference = row[1 : 1 + size] - total[1 : 1 + size]
            mean = total[1 : 1 + size] + difference * (row[0] / count)
            between = difference * difference * (total[0] * row[0] / count)
            squares = total[1 + size :] + row[1 + size :] + between
        out = np.concatenate([[count], mean, squares])
        total = out if np.isfinite(out).all() else total
    return total


def normaliser_of(total: FloatArray) -> FloatArray:
    """Mean and standard deviation (2, d) of moments (1 + 2 d,).

    Zeros and ones if there are no observations; a number that never changes gets the standard
    deviation 1.
    """
    size = len(total) // 2
    if not len(total) or total[0] == 0.0:
        return np.stack([np.zeros(size), np.ones(size)])
    deviation = np.sqrt(total[1 + size :] / total[0])
    return np.stack([total[1 : 1 + size], np.where(deviation > _FLAT, deviation, 1.0)])
