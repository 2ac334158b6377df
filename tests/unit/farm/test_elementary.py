"""Elementary functions: near the true values, and the same bits for every shape of the argument."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest

from farm import elementary

FUNCTIONS = {
    "exp": elementary.exp,
    "cos": elementary.cos,
    "sin": elementary.sin,
    "tanh": elementary.tanh,
}
WITHIN = {"exp": 1.5, "cos": 2.5, "sin": 2.5, "tanh": 3.0}
"""Units in the last place."""

PI = Decimal(
    "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899862803482534211707"
)


def exact(name, x):
    """To some eighty digits."""
    with localcontext() as context:
        context.prec = 100
        x = Decimal(x)
        if name == "exp":
            return x.exp()
        if name == "tanh":
            return 1 - 2 / ((2 * x).exp() + 1)
        x = (x if name == "sin" else x + PI / 2).remainder_near(2 * PI)
        term = total = x
        for k in range(2, 80, 2):
            term *= -x * x / (k * (k + 1))
            total += term
        return total


def error(name, x):
    """In units in the last place of the true value, (n,)."""
    results = FUNCTIONS[name](x)
    out = []
    for value, y in zip(x.tolist(), results.tolist(), strict=True):
        truth = exact(name, value)
        out.append(abs(float((Decimal(y) - truth) / Decimal(math.ulp(float(truth))))))
    return np.array(out)


def many(seed, count):
    """Arguments of every size."""
    rng = np.random.default_rng(seed)
    sizes = 10.0 ** rng.uniform(-12, 5.9, count)
    return np.concatenate(
        [rng.uniform(-2, 2, count), rng.uniform(-40, 40, count), rng.choice([-1, 1], count) * sizes]
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_near_the_true_values(name):
    x = many(1, 700)
    if name == "exp":
        x = np.concatenate([x[np.abs(x) < 700], np.random.default_rng(2).uniform(-708, 709, 300)])
    if name == "tanh":
        x = x[np.abs(x) < 100]
    assert error(name, x).max() <= WITHIN[name]


@pytest.mark.parametrize("name", ["cos", "sin"])
def test_near_the_true_values_beside_the_zeros(name):
    zeros = 0.5 * math.pi * np.concatenate([np.arange(1, 200), np.arange(600_001, 600_200)])
    x = np.concatenate([zeros, np.nextafter(zeros, 0.0), np.nextafter(zeros, np.inf), -zeros])
    assert error(name, x).max() <= WITHIN[name]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_near_those_of_the_c_library(name):
    x = many(3, 30_000)
    if name == "exp":
        x = x[np.abs(x) < 700]
    expected = np.array([getattr(math, name)(value) for value in x.tolist()])
    # It errs itself, by a unit at most: twice that where the next power of two begins.
    assert (
        np.abs(FUNCTIONS[name](x) - expected) <= (WITHIN[name] + 2.0) * np.spacing(np.abs(expected))
    ).all()


@pytest.mark.parametrize(
    ("name", "x", "expected"),
    [
        (
            "exp",
            [0.0, -0.0, np.inf, -np.inf, 1e300, -1e300, 5e-324],
            [1.0, 1.0, np.inf, 0.0, np.inf, 0.0, 1.0],
        ),
        (
            "exp",
            [710.0, -745.0, -746.0, 709.782712893384],
            [np.inf, 5e-324, 0.0, math.exp(709.782712893384)],
        ),
        ("cos", [0.0, -0.0, 5e-324, 0.5 * math.pi], [1.0, 1.0, 1.0, math.cos(0.5 * math.pi)]),
        ("sin", [0.0, 5e-324, -5e-324, math.pi], [0.0, 5e-324, -5e-324, math.sin(math.pi)]),
        (
            "tanh",
            [0.0, 5e-324, 20.0, -20.0, np.inf, -np.inf, 1e300],
            [0.0, 5e-324, 1.0, -1.0, 1.0, -1.0, 1.0],
        ),
        ("cos", [1e7, -1e22, 1.7e308], [math.cos(1e7), math.cos(1e22), math.cos(1.7e308)]),
        ("sin", [1e7, -1e22, 1.7e308], [math.sin(1e7), -math.sin(1e22), math.sin(1.7e308)]),
    ],
)
def test_at_the_edges(name, x, expected):
    np.testing.assert_allclose(FUNCTIONS[name](np.array(x)), expected, rtol=1e-15, atol=0.0)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_no_number_stays_none_and_spoils_no_neighbour(name):
    x = np.array([0.3, np.nan, 1.7, *([np.inf, -np.inf] if name in ("cos", "sin") else []), -0.2])
    results = FUNCTIONS[name](x)
    assert np.isfinite(results).tolist() == np.isfinite(x).tolist()
    np.testing.assert_array_equal(results[np.isfinite(x)], FUNCTIONS[name](x[np.isfinite(x)]))


def test_they_stay_within_their_bounds():
    x = np.random.default_rng(4).uniform(-1e-3, 1e-3, 100_000)
    assert np.abs(elementary.cos(x)).max() <= 1.0
    assert np.abs(elementary.sin(0.5 * math.pi + x)).max() <= 1.0
    assert np.abs(elementary.tanh(many(5, 30_000))).max() <= 1.0
    assert elementary.exp(-np.abs(x)).max() <= 1.0


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("count", [1, 7, 64, 1000])
def test_same_bits_in_any_array(name, count):
    x = many(6, 7000)  # more than one block
    x[::500] = 3e7
    whole = FUNCTIONS[name](x)
    parts = [FUNCTIONS[name](x[first : first + count]) for first in range(0, 3 * count, count)]
    assert np.concatenate(parts).tobytes() == whole[: 3 * count].tobytes()
    tail = FUNCTIONS[name](x[-count:])  # of another block, at other places of memory
    assert tail.tobytes() == whole[-count:].tobytes()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_bits_in_any_layout(name):
    x = many(7, 800).reshape(20, 120)
    whole = FUNCTIONS[name](x)
    assert whole.shape == x.shape
    wide = np.zeros((20, 361))
    wide[:, 1::3] = x
    for view in (np.asfortranarray(x), wide[:, 1::3], x[::-1][::-1]):
        assert FUNCTIONS[name](view).tobytes() == whole.tobytes()
    assert FUNCTIONS[name](x.T).T.tobytes() == whole.tobytes()
    # No multiple of eight in memory
    shifted = np.frombuffer(b"1234" + x.tobytes(), dtype="<f8", offset=4)
    assert FUNCTIONS[name](shifted).tobytes() == whole.tobytes()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_empty_and_of_no_dimension(name):
    assert FUNCTIONS[name](np.zeros((0, 8))).shape == (0, 8)
    assert FUNCTIONS[name](np.array(0.3)).shape == ()
    assert float(FUNCTIONS[name](np.array(0.3))) == FUNCTIONS[name](np.array([0.3]))[0]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_argument_is_left_alone(name):
    x = many(8, 100)
    before = x.copy()
    x.setflags(write=False)
    FUNCTIONS[name](x)
    np.testing.assert_array_equal(x, before)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("count", [3, 1000])
def test_a_result_belongs_to_the_caller(name, count):
    x = np.linspace(-2.0, 2.0, count)
    first = FUNCTIONS[name](x)
    expected = first.copy()
    first[:] = 9.0  # the same numbers again, which may be remembered
    np.testing.assert_array_equal(FUNCTIONS[name](x), expected)


# ---------------------------------------------------------------- turns, single precision


def single(seed, count):
    """Arguments of every size, in single precision."""
    return many(seed, count).astype(np.float32)


def test_cosine_of_turns_is_near_the_true_values():
    x = single(8, 30_000)
    x = np.concatenate([x, np.arange(-9, 9, dtype=np.float32) / 8])
    turned = np.remainder(x.astype(float), 1.0)  # exact
    assert np.abs(elementary.cos_turns(x) - np.cos(2.0 * np.pi * turned)).max() < 2e-7


def test_cosine_of_turns_at_the_edges():
    x = np.array(
        [0, 0.25, 0.5, 2**23 + 1, 2**24 + 2, 3e38, np.inf, -np.inf, np.nan], dtype=np.float32
    )
    cosines = elementary.cos_turns(x)
    assert cosines.dtype == np.float32
    np.testing.assert_allclose(cosines[:6], [1, 0, -1, 1, 1, 1], atol=1e-7)
    assert np.isnan(cosines[6:]).all()


def test_cosine_of_turns_has_the_same_bits_in_any_array():
    x = single(9, 7000)
    whole = elementary.cos_turns(x)
    assert (
        np.concatenate([elementary.cos_turns(x[i : i + 7]) for i in range(0, len(x), 7)]).tobytes()
        == whole.tobytes()
    )
