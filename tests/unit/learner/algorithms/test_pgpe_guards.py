"""PGPE where its equations are undefined: division by zero, values that are not finite, bounds of
sigma and speed.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pgpe_cases import ALL, CHOICES, cases, name_of, sample, state_of

from learner.algorithms import PGPE, Diverged

# Without a baseline single rollouts always move mu.
STILL = [
    choices
    for choices in ALL
    if (choices["estimator"], choices["baseline"], choices["shaping"]) != ("plain", "none", "raw")
]


@pytest.mark.parametrize("choices", cases(of=STILL), ids=name_of)
def test_equal_returns_move_no_mu(choices):
    config = PGPE(**choices)
    state = config.init(4)
    eps = config.ask(state, np.random.default_rng(0))
    after = config.tell(state, eps, np.full(config.returns_shape, -3.0))
    np.testing.assert_allclose(after.mu, state.mu, atol=1e-12)


def test_equal_sides_move_nothing_whatever_the_best_is():
    config = PGPE(baseline="none", learning_rate_sigma=0.0)
    state, eps, _ = sample(0, config)
    for value in (state.best, 0.0, -2.0):
        after = config.tell(state, eps, np.full(config.returns_shape, value))
        assert after.mu.tobytes() == state.mu.tobytes()


def test_a_vanishing_denominator_moves_nothing():
    config = PGPE(pairs=1, normaliser="thesis", learning_rate_sigma=0.0)
    state = state_of(config, [1.0], [2.0], best=5.0, baseline=0.0)
    after = config.tell(state, np.array([[1.0]]), np.array([[4.0, 1.0]]))  # 5 - 4 - 1 = 0
    assert after.mu[0] == 1.0


@pytest.mark.parametrize("estimator", CHOICES["estimator"])
@pytest.mark.parametrize("normaliser", CHOICES["normaliser"])
def test_a_baseline_equal_to_the_best_moves_no_sigma(estimator, normaliser):
    config = PGPE(pairs=2, estimator=estimator, normaliser=normaliser, sigma_rule="bare")
    state = state_of(config, [1.0], [2.0], best=-1.0, baseline=-1.0)
    returns = np.array([-1.0, -2.0, -3.0, -4.0]).reshape(config.returns_shape)
    after = config.tell(state, config.ask(state, np.random.default_rng(0)), returns)
    assert after.sigma[0] == 2.0


@pytest.mark.parametrize("baseline", ["moving-average", "optimal"])
def test_rounding_of_the_baseline_is_no_reason_to_move_sigma(baseline):
    config = PGPE(pairs=7, baseline=baseline, sigma_rule="bare", learning_rate_mu=0.0)
    state, rng = config.init(3), np.random.default_rng(0)
    for _ in range(20):  # 0.9 b + 0.1 b is not always b
        state = config.tell(state, config.ask(state, rng), np.full((7, 2), -0.3))
    np.testing.assert_array_equal(state.sigma, 2.0)


@pytest.mark.parametrize("estimator", CHOICES["estimator"])
def test_the_first_generation_moves_mu_and_sets_the_baseline(estimator):
    config = PGPE(estimator=estimator, sigma_rule="bare")
    state = config.init(2)
    eps = config.ask(state, np.random.default_rng(0))
    returns = np.random.default_rng(1).normal(size=config.returns_shape)
    after = config.tell(state, eps, returns)
    assert after.sigma.tobytes() == state.sigma.tobytes()
    assert (after.mu != state.mu).all()
    assert after.baseline == pytest.approx(returns.mean())


@pytest.mark.parametrize("rule", CHOICES["sigma_rule"])
def test_sigma_stays_above_its_floor(rule):
    config = PGPE(pairs=50, sigma_rule=rule, sigma_floor=0.01, sigma_cap=1.0)
    state, eps, returns = sample(0, config)
    returns[:] = -50.0  # far below the baseline, with far too large eps: sigma would be negative
    returns[::2] = 1.5
    eps[::2] *= 1e-3
    after = config.tell(state, eps * np.where(np.arange(50) % 2, 10.0, 1.0)[:, None], returns)
    np.testing.assert_array_equal(after.sigma, np.full(3, 0.01))


@settings(deadline=None)
@given(seed=st.integers(0, 2**32), cap=st.floats(0.01, 0.9))
def test_capped_sigma_changes_at_most_by_its_cap(seed, cap):
    config = PGPE(sigma_rule="capped", sigma_cap=cap, learning_rate_sigma=5.0)
    state, eps, returns = sample(seed, config)
    after = config.tell(state, eps, returns)
    assert (np.abs(after.sigma / state.sigma - 1.0) <= cap * (1 + 1e-9)).all()


def test_worse_than_the_baseline_moves_no_sigma_of_the_positive_rule():
    config = PGPE()
    state, eps, returns = sample(0, config)
    assert config.tell(state, eps, returns - 100.0).sigma.tobytes() == state.sigma.tobytes()


def test_without_baseline_negative_returns_do_not_favour_the_worst():
    config = PGPE(pairs=2, baseline="none", sigma_rule="bare")
    state = state_of(config, [0.0], [1.0], best=-1.0)
    eps = np.array([[2.0], [1.0]])  # S = 3 and 0: far out was bad, so sigma must shrink
    assert config.tell(state, eps, np.array([[-9.0, -9.0], [-2.0, -2.0]])).sigma[0] < 1.0


@settings(deadline=None)
@given(seed=st.integers(0, 2**32), scale=st.sampled_from((1e-200, 1e-3, 1.0, 1e6, 1e100)))
def test_clipup_keeps_its_speed_limit(seed, scale):
    config = PGPE(optimiser="clipup", learning_rate_mu=0.5, max_speed=0.3, learning_rate_sigma=0.0)
    state, eps, returns = sample(seed, config, size=6)
    for _ in range(3):
        before, state = state, config.tell(state, eps * scale, returns)
        assert np.linalg.norm(state.mu - before.mu) <= 0.3 * (1 + 1e-9)
        assert np.linalg.norm(state.velocity) == pytest.approx(0.3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["eps", "returns"])
def test_a_non_finite_input_is_refused(bad, name):
    config = PGPE()
    state, eps, returns = sample(0, config)
    {"eps": eps, "returns": returns}[name][3, 0] = bad
    with pytest.raises(ValueError, match=f"{name} has non-finite"):
        config.tell(state, eps, returns)


@pytest.mark.parametrize("estimator", CHOICES["estimator"])
def test_a_wrong_shape_is_refused(estimator):
    config = PGPE(estimator=estimator)
    state, eps, returns = sample(0, config)
    with pytest.raises(ValueError, match="returns has the shape"):
        config.tell(state, eps, returns.T)
    with pytest.raises(ValueError, match="eps has the shape"):
        config.tell(state, eps[:, :-1], returns)


@pytest.mark.parametrize("choices", cases(), ids=name_of)
def test_an_overflow_is_diverged_or_finite_and_leaves_the_state(choices):
    config = PGPE(learning_rate_mu=1e300, learning_rate_sigma=1e300, **choices)
    state, eps, returns = sample(0, config)
    before = state.mu.tobytes(), state.sigma.tobytes()
    try:
        after = config.tell(state, eps * 1e200, returns)
        assert np.isfinite(after.mu).all()
        assert np.isfinite(after.sigma).all()
    except Diverged:
        pass
    assert (state.mu.tobytes(), state.sigma.tobytes()) == before


def test_diverged_is_raised():
    config = PGPE(learning_rate_mu=1e308)
    state, eps, returns = sample(0, config)
    with pytest.raises(Diverged, match="generation 4"):
        config.tell(state, eps * 1e10, returns)
