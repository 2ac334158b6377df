"""PGPE compared with its equations in plain Python floats, one number at a time."""

import itertools
import math

import numpy as np
import pytest
from pgpe_cases import CHOICES, cases, name_of

from learner.algorithms import PGPE


def slow_ranks(flat):
    ranks = []
    for value in flat:
        below = sum(other < value for other in flat)
        same = sum(other == value for other in flat)
        ranks.append((below + (same - 1) / 2) / (len(flat) - 1) - 0.5)
    return ranks


def slow_signed_ranks(pairs):
    differences = [plus - minus for plus, minus in pairs]
    signed = []
    for each in differences:
        below = sum(abs(other) < abs(each) for other in differences)
        same = sum(abs(other) == abs(each) for other in differences)
        rank = (below + (same + 1) / 2) / len(differences)
        signed.append(math.copysign(rank, each) if each else 0.0)
    return signed


def slow_optimal_baseline(middles, eps, sigma):
    above = below = 0.0
    for middle, row in zip(middles, eps, strict=True):
        square = 0.0
        for e, s in zip(row, sigma, strict=True):
            square += (e / s**2) ** 2 + ((e**2 - s**2) / s**3) ** 2
        above += middle * square
        below += square
    return above / below


def slow_factors(config, state, eps, returns):
    flat = [r for row in returns for r in row]
    if config.shaping != "raw":
        ranks = iter(slow_ranks(flat))
        shaped = [[next(ranks) for _ in row] for row in returns]
        middles = [sum(row) / len(row) for row in shaped]
        if config.estimator == "plain":
            return middles, middles, None
        if config.shaping == "signed-ranks":
            return slow_signed_ranks(returns), middles, None
        return [(p - m) / 2 for p, m in shaped], middles, None
    best = max([*flat, -math.inf if state.best is None else state.best])
    middles = [sum(row) / len(row) for row in returns]
    mean = sum(flat) / len(flat)
    follow = None
    if config.baseline == "none":
        b = 0.0
    elif config.baseline == "optimal":
        b = follow = slow_optimal_baseline(middles, eps, state.sigma.tolist())
    elif state.baseline is None:
        b = follow = mean
    else:
        b, follow = state.baseline, 0.9 * state.baseline + 0.1 * mean
    to_mu, to_sigma = [], []
    for row, middle in zip(returns, middles, strict=True):
        scaled = (middle - b) / abs(best - b) if best != b else 0.0
        if config.estimator == "symmetric":
            plus, minus = row
            below = (2 * best if config.normaliser == "sehnke" else best) - plus - minus
            to_mu.append((plus - minus) / below if plus != minus and below != 0 else 0.0)
            to_sigma.append(scaled)
        else:
            to_mu.append(scaled if config.normaliser == "sehnke" else middle - b)
            to_sigma.append(to_mu[-1] if best != b else 0.0)
    if config.baseline == "moving-average" and state.baseline is None:
        to_sigma = [0.0] * len(to_sigma)
    return to_mu, to_sigma, follow


def slow_clipup(config, velocity, gradient):
    length = math.sqrt(sum(g * g for g in gradient))
    rate = config.learning_rate_mu
    moved = [
        config.momentum * v + (rate * g / length if length else 0.0)
        for v, g in zip(velocity, gradient, strict=True)
    ]
    speed = math.sqrt(sum(v * v for v in moved))
    return [v * config.max_speed / speed for v in moved] if speed > config.max_speed else moved


def slow_mu(config, state, gradient):
    if config.optimiser == "sgd":
        steps = [config.learning_rate_mu * g for g in gradient]
    elif config.optimiser == "clipup":
        steps = slow_clipup(config, state.velocity.tolist(), gradient)
    else:
        steps, count = [], state.generation + 1
        for g, m, v in zip(gradient, state.first_moment, state.second_moment, strict=True):
            first = config.momentum * m + (1 - config.momentum) * g
            second = config.second_moment_decay * v + (1 - config.second_moment_decay) * g**2
            mean = first / (1 - config.momentum**count)
            root = math.sqrt(second / (1 - config.second_moment_decay**count))
            steps.append(config.learning_rate_mu * mean / (root + 1e-8))
    return [m + s for m, s in zip(state.mu.tolist(), steps, strict=True)]


def slow_tell(config, state, eps, returns):
    """Return mu, sigma and the baseline after one update."""
    eps, returns = eps.tolist(), returns.tolist()
    to_mu, to_sigma, follow = slow_factors(config, state, eps, returns)
    rows = len(eps) if config.shaping != "raw" else 1
    gradient, sigma = [], []
    for i, s in enumerate(state.sigma.tolist()):
        gradient.append(sum(f * row[i] for f, row in zip(to_mu, eps, strict=True)) / rows)
        total = 0.0
        for factor, row in zip(to_sigma, eps, strict=True):
            if config.sigma_rule != "positive" or factor > 0:
                total += factor * (row[i] ** 2 - s**2) / s / rows
        step = config.learning_rate_sigma * total
        if config.sigma_rule == "capped":
            step = max(-config.sigma_cap * s, min(config.sigma_cap * s, step))
        sigma.append(max(s + step, config.sigma_floor))
    return slow_mu(config, state, gradient), sigma, follow


@pytest.mark.parametrize("shaping", CHOICES["shaping"])
@pytest.mark.parametrize("strength", [2, 3])
def test_settings_meet_beside_each_shaping(shaping, strength):
    others = [name for name in CHOICES if name != "shaping"]
    matches = [case for case in cases(strength) if case["shaping"] == shaping]
    for names in itertools.combinations(others, strength):
        combinations = set(itertools.product(*(CHOICES[name] for name in names)))
        assert {tuple(case[name] for name in names) for case in matches} == combinations


@pytest.mark.parametrize("choices", cases(3), ids=name_of)
def test_any_three_settings_agree_with_the_slow_reading(choices):
    config = PGPE(pairs=4, initial_sigma=0.7, learning_rate_mu=0.01, **choices)
    rng = np.random.default_rng(3)
    state = config.init(3)
    for generation in range(3):
        eps = config.ask(state, rng)
        returns = rng.normal(-5.0, 2.0, config.returns_shape).round(1)  # some of them equal
        mu, sigma, baseline = slow_tell(config, state, eps, returns)
        best = max(returns.max(), -math.inf if state.best is None else state.best)
        state = config.tell(state, eps, returns)
        np.testing.assert_allclose(state.mu, mu, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(state.sigma, sigma, rtol=1e-12)
        assert state.baseline == (baseline if baseline is None else pytest.approx(baseline, 1e-12))
        assert (state.best, state.generation) == (best, generation + 1)
