"""SNES, ARS, ES, CMA-ES and sep-CMA: compared with plain versions of their equations, and
resumed.
"""

import builtins
import math
from typing import Any

import cmaes
import numpy as np
import pytest
from made import checkpoint

from farm import plugins
from farm.errors import ConfigError
from learner.algorithms import Diverged, SearchState
from learner.algorithms.ars import ARS
from learner.algorithms.cma import CMAES, CMAState, SepCMA
from learner.algorithms.es import ES
from learner.algorithms.snes import SNES, utilities
from learner.run.checkpoint import load, save

OTHERS: dict[str, Any] = {
    "snes": SNES(pairs=6),
    "ars": ARS(pairs=6, top=3, learning_rate_mu=0.1, initial_sigma=0.1),
    "es": ES(pairs=6, learning_rate_mu=0.1),
    "cma-es": CMAES(population=8),
    "sep-cma": SepCMA(population=8),
}
P = 5


def sphere(theta):
    return -((theta - 3.0) ** 2).sum(axis=-1)


def generation(algorithm, state, seed, value=sphere):
    eps = algorithm.ask(state, np.random.default_rng(seed))
    signs = np.array(algorithm.signs())
    returns = value(state.mu + signs[None, :, None] * eps[:, None, :])
    return algorithm.tell(state, eps, returns), eps, returns


def bits(state):
    return {n: v.tobytes() if isinstance(v, np.ndarray) else v for n, v in state.to_dict().items()}


def learnt(algorithm, state, first, last):
    for seed in range(first, last):
        state, _, _ = generation(algorithm, state, seed)
    return state


@pytest.mark.parametrize("name", OTHERS)
def test_it_is_chosen_by_its_name_and_climbs(name):
    algorithm = OTHERS[name]
    assert plugins.find("algorithms", name).target is type(algorithm)
    start = algorithm.init(P)
    end = learnt(algorithm, start, 0, 120)
    assert sphere(start.mu) == -45.0
    assert sphere(end.mu) > -0.1
    assert (end.generation, start.generation) == (120, 0)
    assert end.best >= sphere(end.mu) - 0.5


@pytest.mark.parametrize("name", OTHERS)
def test_a_state_goes_through_a_checkpoint_to_the_same_bits(name, tmp_path):
    algorithm = OTHERS[name]
    whole = learnt(algorithm, algorithm.init(P), 0, 6)
    half = learnt(algorithm, algorithm.init(P), 0, 3)
    before = bits(half)
    save(tmp_path / "checkpoint", checkpoint(state=half.to_dict()))
    back = algorithm.restore(load(tmp_path / "checkpoint").state)
    assert bits(learnt(algorithm, back, 3, 6)) == bits(whole)
    assert bits(half) == before, "asked and told, a state stays as it is"
    assert not whole.mu.flags.writeable
    with pytest.raises(ValueError, match="state: .*sigma"):
        algorithm.restore({**half.to_dict(), "sigma": np.ones(P + 1)})
    with pytest.raises(ValueError, match="state: unknown colour"):
        algorithm.restore({**half.to_dict(), "colour": 1})


@pytest.mark.parametrize("name", OTHERS)
def test_ask_and_tell_are_pure_and_checked(name):
    algorithm = OTHERS[name]
    state = learnt(algorithm, algorithm.init(P), 0, 2)
    one, two = generation(algorithm, state, 9), generation(algorithm, state, 9)
    assert one[1].tobytes() == two[1].tobytes()
    assert bits(one[0]) == bits(two[0])
    _, eps, returns = one
    assert (eps.shape[1], returns.shape) == (P, (len(eps), len(algorithm.signs())))
    for wrong in (
        (eps[:-1], returns),
        (eps, returns[:-1]),
        (eps, returns[:, :0]),
        (eps * np.nan, returns),
    ):
        with pytest.raises(ValueError, match=r"has the shape|non-finite"):
            algorithm.tell(state, *wrong)


@pytest.mark.parametrize("name", OTHERS)
def test_returns_may_be_shifted_and_scaled(name):
    algorithm = OTHERS[name]
    state = learnt(algorithm, algorithm.init(P), 0, 2)
    plain, other = (
        generation(algorithm, state, 4, value)[0]
        for value in (sphere, lambda x: 8.0 * sphere(x) - 64.0)
    )
    np.testing.assert_allclose(other.mu, plain.mu, rtol=1e-9)
    np.testing.assert_allclose(other.sigma, plain.sigma, rtol=1e-12)


@pytest.mark.parametrize("name", ["snes", "ars", "es"])
def test_equal_returns_move_no_mean(name):
    algorithm = OTHERS[name]
    state = algorithm.init(P)
    after = algorithm.tell(
        state, algorithm.ask(state, np.random.default_rng(0)), np.full((6, 2), -1e12)
    )
    np.testing.assert_allclose(after.mu, state.mu, atol=1e-15)
    np.testing.assert_allclose(after.sigma, state.sigma, rtol=1e-15)


def test_snes_as_written():
    algorithm = OTHERS["snes"]
    before = learnt(algorithm, algorithm.init(P), 0, 2)
    after, eps, returns = generation(algorithm, before, 7)
    samples = [
        (r, sign * e)
        for e, pair in zip(eps, returns, strict=True)
        for sign, r in zip((1, -1), pair, strict=True)
    ]
    samples.sort(key=lambda sample: -sample[0])
    logs = [max(0.0, math.log(12 / 2 + 1) - math.log(k)) for k in range(1, 13)]
    mu, exponent = before.mu.copy(), np.zeros(P)
    for (_, e), log in zip(samples, logs, strict=True):
        u, s = log / sum(logs) - 1 / 12, e / before.sigma
        mu += before.sigma * u * s
        exponent += 0.5 * (3 + math.log(P)) / (5 * math.sqrt(P)) * u * (s**2 - 1)
    np.testing.assert_allclose(after.mu, mu, rtol=1e-12)
    np.testing.assert_allclose(after.sigma, before.sigma * np.exp(exponent), rtol=1e-12)


def test_utilities_of_ties_and_of_any_order():
    returns = np.array([[3.0, -1.0], [3.0, 2.0], [-1.0, 7.0]])
    weights = utilities(returns)
    assert weights[0, 0] == weights[1, 0]
    assert weights[0, 1] == weights[2, 0]
    assert weights.ravel().argmax() == 5
    assert weights.sum() == pytest.approx(0.0, abs=1e-15)
    assert utilities(returns[::-1]).tolist() == weights[::-1].tolist()


def test_ars_as_written():
    algorithm = OTHERS["ars"]
    before = learnt(algorithm, algorithm.init(P), 0, 2)
    after, eps, returns = generation(algorithm, before, 7)
    order = sorted(range(6), key=lambda n: -max(returns[n]))[:3]
    spread = np.std([r for n in order for r in returns[n]])
    step = sum((returns[n][0] - returns[n][1]) * eps[n] / 0.1 for n in order)
    np.testing.assert_allclose(after.mu, before.mu + 0.1 / (3 * spread) * step, rtol=1e-12)
    assert after.sigma.tolist() == [0.1] * P


def test_es_as_written():
    algorithm = ES(pairs=6, learning_rate_mu=0.1, initial_sigma=0.2, weight_decay=0.3)
    state, mu, m, v = algorithm.init(P), np.zeros(P), np.zeros(P), np.zeros(P)
    for t in range(1, 5):
        state, eps, returns = generation(algorithm, state, t)
        ranks = np.empty(12)
        ranks[np.argsort(returns.ravel())] = np.arange(12) / 11 - 0.5
        g = (
            sum((ranks[2 * n] - ranks[2 * n + 1]) * eps[n] / 0.2 for n in range(6)) / (2 * 6 * 0.2)
            - 0.3 * mu
        )
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        mu = mu + 0.1 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        np.testing.assert_allclose(state.mu, mu, rtol=1e-10)
    assert state.sigma.tolist() == [0.2] * P


def test_es_sees_only_the_order_of_returns():
    algorithm = OTHERS["es"]
    state = learnt(algorithm, algorithm.init(P), 0, 2)
    values = (sphere, lambda x: 8.0 * sphere(x) - 64.0, lambda x: np.exp(sphere(x) / 20.0))
    one, *others = (generation(algorithm, state, 4, value)[0] for value in values)
    for other in others:
        assert {**bits(other), "best": 0} == {**bits(one), "best": 0}


def test_the_weight_decay_of_es_pulls_to_zero():
    means = {}
    for decay in (0.0, 0.1):
        algorithm = ES(pairs=6, initial_mu=2.0, weight_decay=decay)
        state = algorithm.init(P)
        for seed in range(100):
            eps = algorithm.ask(state, np.random.default_rng(seed))
            state = algorithm.tell(state, eps, np.zeros((6, 2)))
        means[decay] = state.mu
    assert means[0.0].tolist() == [2.0] * P
    assert np.abs(means[0.1]).max() < 0.5


def test_es_needs_its_memory():
    values = ES().init(P).to_dict()
    for name in ("first_moment", "second_moment"):
        with pytest.raises(ValueError, match=f"state: {name} must have mu's size 5, it is empty"):
            ES().restore({**values, name: np.empty(0)})
    with pytest.raises(ValueError, match="state: missing first_moment, second_moment"):
        ES().restore(ARS().init(P).to_dict())


def test_ars_uses_no_more_directions_than_there_are():
    with pytest.raises(ConfigError, match=r"top is 5; expected 1 to 4 \(pairs\)"):
        ARS(pairs=4, top=5)
    state = ARS().init(P)
    for pairs, top in ((4, 2), (5, 3)):
        half, same = ARS(pairs=pairs), ARS(pairs=pairs, top=top)
        assert bits(generation(half, state, 1)[0]) == bits(generation(same, state, 1)[0])


@pytest.mark.parametrize(("name", "kind"), [("cma-es", cmaes.CMA), ("sep-cma", cmaes.SepCMA)])
def test_cma_is_the_librarys_own_object_that_lives_on(name, kind):
    algorithm = OTHERS[name]
    state = algorithm.init(P)
    alive = kind(mean=np.zeros(P), sigma=1.0, population_size=8)
    for seed in range(12):
        before = state
        state, eps, returns = generation(algorithm, before, seed)
        alive.ask()
        alive.tell(
            [(before.mu + row, -value) for row, value in zip(eps, returns[:, 0], strict=True)]
        )
        np.testing.assert_allclose(state.mu, alive.mean, rtol=1e-9, atol=1e-12)
    covariance = alive._C
    variances = np.diag(covariance) if covariance.ndim == 2 else covariance
    np.testing.assert_allclose(state.sigma, alive._sigma * np.sqrt(variances), rtol=1e-9)
    assert isinstance(state, CMAState)
    samples = algorithm.ask(state, np.random.default_rng(0))
    assert np.abs(samples).max() < 6 * state.sigma.max()


def test_cma_learns_a_direction_that_sep_cma_cannot_have():
    def narrow(theta):  # a valley along the diagonal
        return -(100 * (theta[..., 0] - theta[..., 1]) ** 2 + theta.sum(axis=-1) ** 2)

    state = CMAES(population=8, initial_mu=3.0).init(2)
    for seed in range(60):
        state, _, _ = generation(CMAES(population=8, initial_mu=3.0), state, seed, narrow)
    assert narrow(state.mu) > -1e-6


@pytest.mark.parametrize(
    ("algorithm", "size", "reason"),
    [
        (CMAES(), 1001, "the policy has 1001 parameters; cma-es takes 1 to 1000"),
        (SepCMA(), 1, "the policy has 1 parameters; sep-cma takes 2 to 10000000"),
    ],
)
def test_sizes_that_cma_does_not_take(algorithm, size, reason):
    with pytest.raises(ConfigError, match=reason):
        algorithm.init(size)


def test_what_is_missing_is_said_in_one_line(monkeypatch):
    original = builtins.__import__

    def missing(name, *rest):
        if name == "cmaes":
            raise ImportError(name)
        return original(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ConfigError, match=r"algorithm sep-cma needs cmaes: pip install cmaes$"):
        SepCMA().init(3)


@pytest.mark.parametrize("name", OTHERS)
def test_an_update_that_would_not_be_finite(name):
    algorithm = OTHERS[name]
    state = algorithm.init(P)
    eps = np.sign(algorithm.ask(state, np.random.default_rng(0))) * 1e308
    returns = np.linspace(-1.0, 1.0, len(eps) * len(algorithm.signs())).reshape(len(eps), -1)
    with pytest.raises(Diverged, match="the update after generation 0"):
        algorithm.tell(state, eps, returns)


def test_states_of_one_kind_are_no_others():
    full, diagonal = CMAES().init(3), SepCMA().init(3)
    for algorithm, state in ((CMAES(), diagonal), (SepCMA(), full)):
        with pytest.raises(ValueError, match="state: covariance has"):
            algorithm.restore(state.to_dict())
    with pytest.raises(ValueError, match="state: missing"):
        CMAES().restore(SearchState(mu=np.zeros(3), sigma=np.ones(3)).to_dict())
