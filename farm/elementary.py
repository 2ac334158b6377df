"""exp, cos, sin and tanh that give the same bits on every processor.

Pure. numpy has versions of these functions for several processors, which round differently. Here
each step is one numpy operation whose rounding IEEE 754 defines (sum, product, quotient, rounding
to whole numbers, power of two), so that no compiler can fuse two of them. An element's result
depends only on its value.

Arguments are reduced with a constant split into short parts, whose products with a whole number are
exact (Cody & Waite 1980, Software Manual for the Elementary Functions). Of the reduced argument r,
z = r^2:

    sin(r) = r + r z Q(z), |r| <= pi / 2; Q of degree 7 interpolates (sin(r)/r - 1)/z at the
             eight Chebyshev nodes of 0 <= z <= pi^2 / 4, solved in fractions, then rounded: its
             own relative error is below 4e-17
    exp(r) = 1 + 2 r / (r coth(r/2) - r), |r| <= ln(2) / 2; r coth(r/2) = 2 + sum B_2k z^k 2 / (2k)!
             with the Bernoulli numbers B_2k (the series that defines them), up to z^6: what is left
             out is below 1e-17

    cos_turns(x) = -s P(s^2), s = |x - rint(x)| - 1/4; P interpolates sin(2 pi s) / s likewise,
             at the five nodes of 0 <= s^2 <= 1/16: its own error is below 1e-8

Errors, held by `tests/unit/farm/test_elementary.py`: below 1.5 units in the last place for exp, 2.5
for cos and sin, 3 for tanh; 2e-7 for cos_turns.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray, FloatArray

_BLOCK: Final = 8192  # elements per block: they and the intermediate results stay in a core's cache
_FEW: Final = 256  # elements whose result is remembered for a while


def _constants(*values: float) -> tuple[FloatArray, ...]:
    """Zero-dimensional arrays: with small arrays numpy is a third faster than with Python's
    numbers.
    """
    return tuple(np.array(value) for value in values)


_PI: Final = _constants(
    *map(float.fromhex, ("0x1.921fb54400000p+1", "0x1.0b4611a600000p-33", "0x1.3198a2e037073p-68"))
)
_SINE: Final = _constants(
    *(
        2.7314447669863995e-15,
        -7.643970296798572e-13,
        1.6058977312464087e-10,
        -2.5052107616996182e-08,
    ),
    *(2.7557319219163234e-06, -0.00019841269841254974, 0.008333333333333316, -0.16666666666666666),
)
_HALF_TURNS, _HALF = _constants(1.0 / math.pi, 0.5)
# Last bit of a whole number's sum with them: is it odd?
_EVEN, _ODD = _constants(1.5 * 2.0**52, 1.5 * 2.0**52 + 1.0)
_LAST_TO_SIGN: Final = np.array(63)
_LARGE: Final = 1e6  # above this, products with the parts of pi are not exact
_USUAL: Final = 700.0  # up to this magnitude every function's result is an ordinary number

_QUARTER: Final = np.array(0.25, dtype=np.float32)
_TURNS: Final = tuple(
    np.array(value, dtype=np.float32)
    for value in (-39.759827, 76.58117, -81.60248, 41.341682, -6.2831855)
)

_LN2: Final = _constants(*map(float.fromhex, ("0x1.62e42fefa2000p-1", "0x1.9ef35793c7673p-41")))
_COTH: Final = _constants(
    -691 / 653837184000, 1 / 23950080, -1 / 604800, 1 / 15120, -1 / 360, 1 / 6, 2.0
)
_DOUBLINGS, _ONE, _TWO = _constants(float.fromhex("0x1.71547652b82fep+0"), 1.0, 2.0)
_LEAST, _MOST = _constants(-_LARGE, _LARGE)
_FLAT: Final = np.array(40.0)  # largest 2|x|: above it 1 - tanh(|x|) < 2^-54


def exp(x: FloatArray) -> FloatArray:
    """e^x of any array, (...) -> (...)."""
    return _apply(_exp, x)


def tanh(x: FloatArray) -> FloatArray:
    """Hyperbolic tangent of any array, (...) -> (...)."""
    return _apply(_tanh, x)


def cos(x: AnyArray) -> FloatArray:
    """Cosine of any array [rad], (...) -> (...); nan for elements that are not finite."""
    return _apply(_cos, x, math.cos)


def sin(x: FloatArray) -> FloatArray:
    """Sine of any array [rad], (...) -> (...); nan for elements that are not finite."""
    return _apply(_sin, x, math.sin)


def cos_turns(x: AnyArray) -> AnyArray:
    """cos(2 pi x) of any array of float32, (...) -> (...); nan for elements that are not finite."""
    with np.errstate(invalid="ignore"):
        out = np.rint(x)
        np.subtract(x, out, out=out)  # exact
        np.abs(out, out=out)
        out -= _QUARTER
        value = np.empty_like(out)
        _polynomial(_TURNS, out * out, value)
        value *= out
    return value


def _apply(
    function: Callable[[FloatArray, FloatArray], None],
    x: AnyArray,
    otherwise: Callable[[float], float] | None = None,
) -> FloatArray:
    """Apply `function` elementwise; use `otherwise` where abs(x) is above its range."""
    flat = np.asarray(x, dtype=np.float64).ravel()
    if flat.size <= _FEW:
        return _recent(function, otherwise, flat.tobytes()).reshape(np.shape(x)).copy()
    return _computed(function, otherwise, flat).reshape(np.shape(x))


@lru_cache(maxsize=16)
def _recent(function: Any, otherwise: Any, numbers: bytes) -> FloatArray:  # noqa: ANN401  as `_apply` has them
    """The result of a few numbers, remembered: tasks ask for the same goal in `observe`, `reward`
    and `measure`.
    """
    return _computed(function, otherwise, np.frombuffer(numbers))


def _computed(function: Any, otherwise: Any, x: FloatArray) -> FloatArray:  # noqa: ANN401  as `_apply` has them
    """Apply a function to x (n,) without numpy's warnings, in parts that fit a cache; use
    `otherwise` only where it is needed.

    A control step has few numbers: what costs time is the number of numpy's calls, not the numbers.
    """
    out = np.empty(x.size)
    if 0 < x.size <= _BLOCK and np.maximum.reduce(np.abs(x)) <= _USUAL:  # false for nan
        function(x, out)
        return out
    with np.errstate(all="ignore"):
        for first in range(0, x.size, _BLOCK):
            part = slice(first, first + _BLOCK)
            function(np.minimum(np.maximum(x[part], _LEAST), _MOST), out[part])
            if otherwise is not None:
                _replace(otherwise, x[part], out[part])
    return out


def _replace(function: Callable[[float], float], x: FloatArray, out: FloatArray) -> None:
    """Use the C library's function for arguments that are too large for ours.

    This is rare and may be slow.
    """
    usual = np.abs(x) <= _LARGE
    if not usual.all():
        for i in np.flatnonzero(~usual):
            out[i] = function(x[i]) if math.isfinite(x[i]) else math.nan


def _exp(x: FloatArray, out: FloatArray) -> None:
    power = _grow(x, out)
    out += _ONE
    np.ldexp(out, power, out)


def _tanh(x: FloatArray, out: FloatArray) -> None:
    """(e^2|x| - 1) / (e^2|x| + 1), with a numerator that is not a difference of nearly equal
    numbers.
    """
    np.abs(x, out)
    out += out
    np.minimum(out, _FLAT, out=out)
    whole = np.ldexp(_ONE, _grow(out, out))
    out *= whole
    whole -= _ONE
    out += whole
    np.add(out, _TWO, whole)
    out /= whole
    np.copysign(out, x, out)


def _grow(x: FloatArray, out: FloatArray) -> "np.ndarray[tuple[int, ...], np.dtype[np.intc]]":
    """Split x = k ln 2 + r; put e^r - 1 into `out`, which may be x, and return k."""
    whole = x * _DOUBLINGS
    np.rint(whole, whole)
    power = whole.astype(np.intc)
    scratch = whole * _LN2[0]
    np.subtract(x, scratch, out)
    whole *= _LN2[1]
    out -= whole
    np.multiply(out, out, scratch)
    _polynomial(_COTH, scratch, whole)
    whole -= out
    out /= whole
    out += out
    return power


def _cos(x: FloatArray, out: FloatArray) -> None:
    """cos(x) = (-1)^k sin((k + 1/2) pi - x), k = floor(x / pi)."""
    half_turns = x * _HALF_TURNS
    np.floor(half_turns, half_turns)
    odd = half_turns + _EVEN
    half_turns += _HALF
    _sine(x, half_turns, odd, out)


def _sin(x: FloatArray, out: FloatArray) -> None:
    """sin(x) = -(-1)^k sin(k pi - x), k = rint(x / pi)."""
    half_turns = x * _HALF_TURNS
    np.rint(half_turns, half_turns)
    _sine(x, half_turns, half_turns + _ODD, out)


def _sine(x: FloatArray, half_turns: FloatArray, odd: FloatArray, out: FloatArray) -> None:
    """(-1)^odd sin(half_turns pi - x); of `odd` only the last bit counts.

    Arrays but x are overwritten.
    """
    np.multiply(half_turns, _PI[0], out)
    out -= x
    square = half_turns * _PI[1]
    out += square
    half_turns *= _PI[2]
    out += half_turns
    sign, bits = odd.view(np.int64), out.view(np.int64)
    sign <<= _LAST_TO_SIGN
    bits ^= sign
    np.multiply(out, out, square)
    _polynomial(_SINE, square, odd)
    odd *= square
    odd *= out
    out += odd


def _polynomial(coefficients: tuple[AnyArray, ...], z: AnyArray, out: AnyArray) -> None:
    """Horner's scheme, the highest power's coefficient first."""
    first, *middle, last = coefficients
    np.multiply(z, first, out)
    for coefficient in middle:
        out += coefficient
        out *= z
    out += last
