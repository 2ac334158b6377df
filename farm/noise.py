"""Random numbers by counter: each follows from a key, a stream, a step and its own place, not from
the one before. Pure.

The words are those of SplitMix64 (Steele, Lea & Flood 2014, Fast splittable pseudorandom number
generators; constants of Stafford's mix 13): mix(start + i gamma) for the i-th; key, stream and step
are mixed into the start. Normal numbers are those of Box & Muller 1958, two of each word: 32 bits
are the radius, so none is beyond 6.8, and 24 bits the angle. As in `farm.elementary`, IEEE 754
defines every step, so all processors give the same bits.
"""

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Final, Literal, TypeAlias

import numpy as np

from farm.arrays import AnyArray, FloatArray
from farm.elementary import cos_turns

Kind: TypeAlias = Literal["normal", "uniform"]
KINDS: Final[tuple[Kind, ...]] = ("normal", "uniform")

_GAMMA: Final = 0x9E3779B97F4A7C15
_MIX: Final = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
_30, _27, _31, _32, _11, _8 = (np.uint64(bits) for bits in (30, 27, 31, 32, 11, 8))
_24_BITS: Final = np.uint64(2**24 - 1)
_ROOT: Final = float.fromhex("0x1.6a09e667f3bcdp-1")  # of 1/2, rounded
_LN2: Final = float.fromhex("0x1.62e42fefa39efp-1")
_QUARTER: Final = np.float32(0.25)


def key(seed: Sequence[int]) -> int:
    """A rollout's key, 64 bits, from its seed; no number of the seed's own generator depends on
    it.
    """
    return int(np.random.SeedSequence(seed, spawn_key=(0,)).generate_state(1, np.uint64)[0])


def numbers(
    keys: AnyArray, stream: str, step: int, count: int, kind: Kind = "normal"
) -> FloatArray:
    """Standard normal numbers, or uniform ones of -1 to 1, (B, count).

    Args:
      keys: of the rollouts, uint64 (B,).
      stream: name of what draws them; another name gives other numbers, and so does the other kind.
      step: a control step.
      count: numbers of each rollout.
      kind: one of KINDS.
    """
    start = _mixed(keys ^ _named(f"{kind} {step} {stream}"))
    if kind == "uniform":
        return (_words(start, count) >> _11).astype(float) * 2.0**-52 - 1.0
    return _normal(_words(start, (count + 1) // 2))[:, :count]


def _named(text: str) -> np.uint64:
    return np.uint64(int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little"))


@lru_cache(maxsize=64)
def _places(count: int) -> AnyArray:
    """Multiples i gamma, i from 1, (count,)."""
    return np.arange(1, count + 1, dtype=np.uint64) * np.uint64(_GAMMA)


def _words(start: AnyArray, count: int) -> AnyArray:
    """Random words (B, count) of starts (B,)."""
    return _mixed(start[:, None] + _places(count))


def _mixed(z: AnyArray) -> AnyArray:
    z ^= z >> _30
    z *= _MIX[0]
    z ^= z >> _27
    z *= _MIX[1]
    z ^= z >> _31
    return z


def _normal(words: AnyArray) -> FloatArray:
    """Normal numbers (B, 2 n) of words (B, n)."""
    radius = _radius(((words >> _32).astype(float) + 0.5) * 2.0**-32)
    angles = np.empty((2, *words.shape), np.float32)
    np.multiply((words >> _8) & _24_BITS, 2.0**-24, angles[0], casting="unsafe")  # exact
    np.subtract(angles[0], _QUARTER, angles[1])
    return np.concatenate(radius * cos_turns(angles), axis=1)


def _radius(u: FloatArray) -> FloatArray:
    """sqrt(-2 ln u) for 0 < u < 1, to 2e-6.

    With u = m 2^e, 1/2 <= m < 1, and s = (m - c) / (m + c), c = sqrt(1/2):
    ln u = e ln 2 + ln c + 2 (s + s^3 / 3 + s^5 / 5 + ...).
    """
    m, e = np.frexp(u)
    s = m - _ROOT
    m += _ROOT
    s /= m
    z = s * s
    series = z * (1.0 / 11.0)
    for odd in (9.0, 7.0, 5.0, 3.0):
        series += 1.0 / odd
        series *= z
    series += 1.0
    series *= s
    series *= -4.0
    series -= (e - 0.5) * (2.0 * _LN2)
    return np.sqrt(np.maximum(series, 0.0))
