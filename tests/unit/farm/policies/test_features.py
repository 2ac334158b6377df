"""Random features: as their formula, and near the Gaussian kernel.

The constants that they are made of.
"""

import math

import numpy as np
import pytest
from controllers import make, states

from farm.errors import UnservedError
from farm.policies.fourier import Direct, FeaturesConfig
from farm.tasks.base import TaskSpec


def kernel_error(features, size, bandwidth, seed):
    policy = make("direct", features, size, seed, bandwidth)
    x, y = states(12, size, 1) * bandwidth, states(12, size, 2) * bandwidth
    exact = [
        math.exp(-(math.dist(a, b) ** 2) / (2 * bandwidth**2)) for a, b in zip(x, y, strict=True)
    ]
    errors = (policy.features(x) * policy.features(y)).sum(axis=1) - exact
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize(("size", "bandwidth"), [(8, 1.0), (8, 0.3), (17, 2.0)])
def test_features_approximate_the_gaussian_kernel_better_with_more_of_them(size, bandwidth):
    coarse, middle, fine = (
        np.mean([kernel_error(count, size, bandwidth, seed) for seed in range(4)])
        for count in (50, 800, 12800)
    )
    assert fine < 0.02
    assert 2 < coarse / middle < 8  # as 1 / sqrt(D): 4
    assert 2 < middle / fine < 8


def test_features_are_as_written():
    constants = {
        "frequencies": np.array([[1.0, -2.0], [0.5, 0.25], [0.0, 3.0]]),
        "phases": np.array([0.1, 2.0, 6.0]),
    }
    spec = TaskSpec(observation=2, action=1, steps=1, period=0.1)
    policy = Direct(FeaturesConfig(features=3, bandwidth=0.5), spec, constants)
    x = [0.3, -0.7]
    expected = [
        math.sqrt(2 / 3) * math.cos(sum(w * v for w, v in zip(row, x, strict=True)) / 0.5 + c)
        for row, c in zip(
            constants["frequencies"].tolist(), constants["phases"].tolist(), strict=True
        )
    ]
    np.testing.assert_allclose(policy.features(np.array([x])), [expected], rtol=1e-12)


def test_constants_are_drawn_from_their_distributions_and_the_kernel_has_none():
    constants = make("direct", 20_000).constants
    frequencies, phases = constants["frequencies"], constants["phases"]
    assert (frequencies.shape, phases.shape) == ((20_000, 8), (20_000,))
    np.testing.assert_allclose(frequencies.mean(axis=0), 0.0, atol=0.04)
    np.testing.assert_allclose(frequencies.std(axis=0), 1.0, atol=0.03)
    assert 0 <= phases.min() < 0.01 < 2 * np.pi - 0.01 < phases.max() <= 2 * np.pi
    assert phases.mean() == pytest.approx(np.pi, abs=0.05)
    again = make("direct", 20_000).constants
    assert again["frequencies"].tobytes() == frequencies.tobytes()
    assert make("kernel").constants == {}


@pytest.mark.parametrize("name", ["frequencies", "phases"])
@pytest.mark.parametrize(
    "wrong", [None, np.zeros((50, 17)), np.zeros(49), np.zeros((8, 50)), np.zeros((0, 8))], ids=str
)
def test_constants_of_another_size_are_a_clear_error(name, wrong):
    policy = make("direct")
    constants = {key: values for key, values in policy.constants.items() if key != name}
    constants |= {} if wrong is None else {name: wrong}
    with pytest.raises(
        UnservedError,
        match=rf"constant '{name}' of the policy is .*; expected an array of shape \(50",
    ):
        Direct(policy.config, policy.spec, constants)
