"""PGPE: examples computed by hand, invariances of the update, and a test that it learns."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pgpe_cases import ALL, CHOICES, sample, state_of

from learner.algorithms import PGPE

MODERN = {"shaping": "ranks", "sigma_rule": "capped", "optimiser": "clipup"}


@pytest.mark.parametrize(("normaliser", "contrast"), [("sehnke", 8 / 10), ("thesis", 8 / 11)])
def test_two_pairs_by_hand(normaliser, contrast):
    # m = -1, r+ = -2, r- = -10: 8 / (2m + 12) = 0.8; as printed 8 / (m + 12).
    # The other pair is equal on both sides: it moves no mu.
    config = PGPE(pairs=2, normaliser=normaliser)
    state = state_of(config, [1.0], [2.0], best=-1.0, baseline=-9.0, generation=1)
    eps = np.array([[0.375], [5.0]])
    after = config.tell(state, eps, np.array([[-2.0, -10.0], [-7.0, -7.0]]))
    assert after.mu[0] == pytest.approx(1.0 + 0.1 * 0.375 * contrast, rel=1e-14)
    # r_S = 3/8 and 2/8; S = (0.140625 - 4)/2 and (25 - 4)/2; mean return -6.5.
    assert after.sigma[0] == pytest.approx(2.0 + 0.2 * (0.375 * -1.9296875 + 0.25 * 10.5))
    assert after.baseline == pytest.approx(0.9 * -9.0 + 0.1 * -6.5)
    assert (after.best, after.generation) == (-1.0, 2)


def test_plain_as_printed_by_hand():
    config = PGPE(pairs=1, estimator="plain", normaliser="thesis", sigma_rule="bare")
    state = state_of(config, [0.0], [1.0], best=4.0, baseline=1.0, generation=1)
    after = config.tell(state, np.array([[2.0], [-1.0]]), np.array([[3.0], [0.0]]))
    assert after.mu[0] == pytest.approx(0.1 * (2.0 * 2.0 + -1.0 * -1.0))
    assert after.sigma[0] == pytest.approx(1.0 + 0.2 * (3.0 * 2.0 + 0.0))


def test_ranks_share_ties():
    config = PGPE(pairs=2, learning_rate_mu=1.0, **{**MODERN, "optimiser": "sgd"})
    state = state_of(config, [0.0], [1.0])
    # Ranks of 5, 1, 1, 9 are 2, 0.5, 0.5, 3 of 3: u = 1/6, -1/3, -1/3, 1/2.
    after = config.tell(state, np.array([[1.0], [2.0]]), np.array([[5.0, 1.0], [1.0, 9.0]]))
    assert after.mu[0] == pytest.approx((1.0 * 0.25 - 2.0 * 5 / 12) / 2)
    assert after.sigma[0] == pytest.approx(1.0 + 0.2 * (0.0 * -1 / 12 + 3.0 * 1 / 12) / 2)


def test_signed_ranks_compare_rollouts_from_one_start_only():
    config = PGPE(pairs=4, shaping="signed-ranks", learning_rate_mu=1.0)
    state = state_of(config, [0.0], [1.0])
    # Differences 3, -3, 0 and 100 have the ranks 2.5, 2.5, 1 and 4 of 4
    returns = np.array([[5.0, 2.0], [1.0, 4.0], [7.0, 7.0], [50.0, -50.0]])
    eps = np.array([[1.0], [2.0], [4.0], [8.0]])
    after = config.tell(state, eps, returns)
    assert after.mu[0] == pytest.approx((1.0 * 2.5 - 2.0 * 2.5 + 8.0 * 4.0) / 4 / 4)
    starts = np.array([[30.0], [-90.0], [0.0], [8.0]])
    easier = config.tell(state, eps, returns + starts)
    assert easier.mu.tobytes() == after.mu.tobytes()


def test_optimal_baseline_by_brute_force():
    rng = np.random.default_rng(0)
    config = PGPE(pairs=3, estimator="plain", baseline="optimal")
    state = state_of(config, [1.0, -2.0], [0.5, 3.0])
    eps, returns = config.ask(state, rng), rng.normal(size=(6, 1))
    weights = []
    for theta in (state.mu + eps).tolist():

        def log_density(values, theta=theta):
            mu, sigma = values[:2], values[2:]
            return sum(
                -math.log(s) - (t - m) ** 2 / (2 * s * s)
                for t, m, s in zip(theta, mu, sigma, strict=True)
            )

        at, h = [1.0, -2.0, 0.5, 3.0], 1e-6
        gradient = []
        for i in range(4):
            up, down = list(at), list(at)
            up[i], down[i] = at[i] + h, at[i] - h
            gradient.append((log_density(up) - log_density(down)) / (2 * h))
        weights.append(sum(g * g for g in gradient))
    expected = float((returns[:, 0] * weights).sum() / sum(weights))
    assert config.tell(state, eps, returns).baseline == pytest.approx(expected, rel=1e-6)


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32),
    scale=st.floats(0.01, 100.0),
    shift=st.floats(-50.0, 50.0),
    estimator=st.sampled_from(CHOICES["estimator"]),
    baseline=st.sampled_from(("moving-average", "optimal")),
)
def test_shift_and_scale_of_all_returns_change_nothing(seed, scale, shift, estimator, baseline):
    config = PGPE(estimator=estimator, baseline=baseline, sigma_rule="bare")
    state, eps, returns = sample(seed, config)
    other = dataclasses.replace(
        state, best=state.best * scale + shift, baseline=state.baseline * scale + shift
    )
    one, two = config.tell(state, eps, returns), config.tell(other, eps, returns * scale + shift)
    np.testing.assert_allclose(two.mu, one.mu, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(two.sigma, one.sigma, rtol=1e-8, atol=1e-8)
    assert two.baseline == pytest.approx(one.baseline * scale + shift, rel=1e-8, abs=1e-8)


@settings(deadline=None)
@given(seed=st.integers(0, 2**32), choices=st.sampled_from(ALL))
def test_a_mirrored_pair_is_the_same_pair(seed, choices):
    config = PGPE(**{**choices, "estimator": "symmetric"}, learning_rate_mu=1e-3)
    state, eps, returns = sample(seed, config)
    mirrored = np.random.default_rng(seed).random(config.pairs) < 0.5
    other = np.where(mirrored[:, None], -eps, eps)
    swapped = np.where(mirrored[:, None], returns[:, ::-1], returns)
    one, two = config.tell(state, eps, returns), config.tell(state, other, swapped)
    # The thesis's m - r+ - r- rounds differently as m - r- - r+
    same_bits = config.baseline == "moving-average" and config.normaliser == "sehnke"
    if same_bits or config.shaping != "raw":
        assert one.mu.tobytes() == two.mu.tobytes()
    np.testing.assert_allclose(two.mu, one.mu, rtol=1e-9)
    np.testing.assert_allclose(two.sigma, one.sigma, rtol=1e-9)


@settings(deadline=None)
@given(seed=st.integers(0, 2**32), choices=st.sampled_from(ALL))
def test_the_order_of_the_rows_does_not_matter(seed, choices):
    config = PGPE(**choices, learning_rate_mu=1e-3, learning_rate_sigma=1e-3)
    state, eps, returns = sample(seed, config)
    order = np.random.default_rng(seed).permutation(len(eps))
    one, two = config.tell(state, eps, returns), config.tell(state, eps[order], returns[order])
    np.testing.assert_allclose(two.mu, one.mu, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(two.sigma, one.sigma, rtol=1e-7, atol=1e-9)


def test_memory_layout_does_not_change_a_bit():
    config = PGPE(pairs=40)
    state, eps, returns = sample(1, config, size=50)
    one = config.tell(state, eps, returns)
    two = config.tell(state, np.asfortranarray(eps), np.asfortranarray(returns))
    assert one.mu.tobytes() == two.mu.tobytes()
    assert one.sigma.tobytes() == two.sigma.tobytes()


@pytest.mark.parametrize("estimator", CHOICES["estimator"])
def test_eps_has_the_spread_of_sigma_around_zero(estimator):
    config = PGPE(pairs=20_000, estimator=estimator)
    state = state_of(config, [7.0, 7.0], [0.5, 3.0])
    eps = config.ask(state, np.random.default_rng(0))
    assert eps.shape == (config.returns_shape[0], 2)
    np.testing.assert_allclose(eps.mean(axis=0), 0.0, atol=0.08)
    np.testing.assert_allclose(eps.std(axis=0), [0.5, 3.0], rtol=0.03)


@pytest.mark.parametrize(
    "config",
    [
        PGPE(),
        PGPE(sigma_rule="capped"),
        PGPE(estimator="plain", baseline="optimal", sigma_rule="capped", learning_rate_mu=0.05),
        PGPE(**MODERN, learning_rate_mu=0.3, max_speed=0.6),
        PGPE(**{**MODERN, "optimiser": "adam"}),
        PGPE(**{**MODERN, "optimiser": "sgd"}, learning_rate_mu=1.0),
        PGPE(**{**MODERN, "shaping": "signed-ranks"}, learning_rate_mu=0.3, max_speed=0.6),
    ],
    ids=lambda c: f"{c.estimator}-{c.shaping}-{c.sigma_rule}-{c.optimiser}",
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_climbs_a_round_hill(config, seed):
    target = np.linspace(-1.0, 3.0, 8)
    rng = np.random.default_rng(seed)
    state = config.init(8)
    start = np.square(state.mu - target).sum()
    signs = np.array([1.0, -1.0])[: config.returns_shape[1]]
    for _ in range(150):
        eps = config.ask(state, rng)
        theta = state.mu + signs[:, None] * eps[:, None, :]  # (rows, columns, P)
        state = config.tell(state, eps, -np.square(theta - target).sum(axis=2))
    assert np.square(state.mu - target).sum() < 0.1 * start
