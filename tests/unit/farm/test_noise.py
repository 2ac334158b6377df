"""Random numbers by counter: the published words, the right distributions, and nothing but key,
stream and step.
"""

import math

import numpy as np
import pytest

from farm import noise

EXPECTED = [
    "0x1.15d493d9e64f4p-4",
    "0x1.22f1f6d0a1509p-3",
    "0x1.de67efdce36cap-1",
    "-0x1.3441b59be02f0p-1",
    "0x1.2f5f28ea332a8p-1",
    "-0x1.d77fa1c892d08p-3",
]
"""Three normal numbers and three uniform ones."""

KEYS = np.array([noise.key((3, 1, 2, start)) for start in range(64)], dtype=np.uint64)


def test_the_words_are_those_of_splitmix64():
    published = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]  # of the seed 0
    assert noise._words(np.zeros(1, dtype=np.uint64), 3)[0].tolist() == published


def test_the_bits_are_these_on_every_processor():
    normal, uniform = (noise.numbers(KEYS[:1], "gyro", 7, 3, kind)[0] for kind in noise.KINDS)
    assert [float(value).hex() for value in normal] == EXPECTED[:3]
    assert [float(value).hex() for value in uniform] == EXPECTED[3:]


def test_numbers_of_a_rollout_are_its_own():
    together = noise.numbers(KEYS, "gyro", 7, 5)
    for row in (0, 13, 63):
        alone = noise.numbers(KEYS[row : row + 1], "gyro", 7, 5)
        assert alone.tobytes() == together[row].tobytes()
    assert noise.numbers(KEYS[::-1], "gyro", 7, 5)[::-1].tobytes() == together.tobytes()


def test_another_step_stream_kind_key_or_place_has_other_numbers():
    draws = [
        noise.numbers(KEYS, *each, 6)
        for each in (("a", 1), ("a", 2), ("b", 1), ("", 1), ("", 11), ("1", 1))
    ]
    draws.append(noise.numbers(KEYS, "a", 1, 6, "uniform"))
    assert (
        len({float(value) for draw in draws for value in draw.ravel()})
        == len(draws) * KEYS.size * 6
    )


def test_normal_numbers_have_the_moments_of_a_normal_distribution():
    x = np.stack([noise.numbers(KEYS, "x", step, 41) for step in range(400)])  # a million
    one = 1.0 / math.sqrt(x.size)
    assert abs(x.mean()) < 4 * one
    assert abs(x.var() - 1.0) < 4 * math.sqrt(2) * one
    assert abs((x**3).mean()) < 4 * math.sqrt(15) * one
    assert abs((x**4).mean() - 3.0) < 4 * math.sqrt(96) * one
    assert abs((np.abs(x) > 1.959964).mean() - 0.05) < 4 * math.sqrt(0.05) * one
    for lagged in (
        x[1:] * x[:-1],
        x[:, 1:] * x[:, :-1],
        x[..., 1:] * x[..., :-1],
        x[..., 21:] * x[..., :-21],
    ):
        assert abs(lagged.mean()) < 4.5 / math.sqrt(lagged.size)


def test_uniform_numbers_fill_minus_one_to_one():
    x = np.stack([noise.numbers(KEYS, "x", step, 41, "uniform") for step in range(400)])
    counts = np.histogram(x, 64, (-1.0, 1.0))[0]
    expected = x.size / 64
    assert counts.sum() == x.size
    assert ((counts - expected) ** 2 / expected).sum() < 110.0, (
        "chi square with 63 degrees of freedom"
    )


def test_the_radius_is_sqrt_of_minus_twice_the_logarithm():
    ends = (np.arange(1000) + 0.5) * 2.0**-32
    u = np.concatenate([ends, np.linspace(0.001, 0.999, 9999), 1.0 - ends])
    assert np.abs(noise._radius(u) - [math.sqrt(-2.0 * math.log(each)) for each in u]).max() < 2e-6


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_any_count_of_numbers(count: int):
    assert noise.numbers(KEYS, "x", 0, count).shape == (64, count)
    assert noise.numbers(KEYS, "x", 0, 8)[:, :1].shape == (64, 1)
