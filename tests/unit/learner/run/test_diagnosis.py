"""Runs that do not learn are told so, once, and others are not."""

import numpy as np
import pytest
from made import stats

from learner.algorithms import PGPE
from learner.algorithms.es import ES
from learner.run.diagnosis import FALLEN, REPEATED, STALE, WINDOW, Diagnosis


def messages(returns, algorithm=None, *, one_step=False, **changed):
    """Messages by generation of a run whose mean policy returns this."""
    diagnosis = Diagnosis(algorithm or ES())
    texts = {}
    for g, value in enumerate(returns, start=1):
        for message in diagnosis.after(
            stats(g, mean_policy_return=value, **changed), one_step=one_step
        ):
            texts.setdefault(g, []).append(message)
    return texts


def noisy(values, deviation=1.0):
    return np.asarray(values) + np.random.default_rng(0).normal(0.0, deviation, len(values))


def test_a_run_that_improves_says_nothing():
    assert messages(noisy(np.linspace(-100.0, 0.0, 400))) == {}


def test_a_run_that_succeeds_may_stay_where_it_is():
    assert messages([-1.0] * 300, mean_policy_success=True, sigma_max=1e-9) == {}


def test_a_failed_mean_policy_is_no_fall():
    returns = [*np.linspace(-100.0, -50.0, 40), *[None, -50.0] * 25]
    assert messages(returns, failed=1) == {}


def test_no_improvement():
    texts = messages([*np.linspace(-100.0, -50.0, 40), *[-50.0] * 150])
    [(generation, [message])] = texts.items()
    assert generation == 40 + WINDOW - 1 + STALE
    assert "has not improved for 100 generations" in message
    assert "returned -50 around generation 49" in message
    assert "farm tune" in message


def test_a_fall_after_a_rise():
    texts = messages(noisy([*np.linspace(-60.0, 30.0, 50), *np.linspace(30.0, -200.0, 60)]))
    [(generation, [message])] = texts.items()
    assert 50 + FALLEN < generation < 50 + 2 * FALLEN + WINDOW
    assert "has become worse" in message
    assert "smaller --learning-rate-mu" in message


@pytest.mark.parametrize(("end", "said"), [(46.4, 0), (44.5, 0), (44.0, 1), (30.0, 1)])
def test_a_fall_of_a_few_percent_is_none(end, said):
    texts = messages([46.0, *[46.7] * 20, *[end] * 60])
    assert sum("has become worse" in each for [each] in texts.values()) == said


def test_noise_is_no_fall():
    assert messages(noisy(np.zeros(90), 5.0)) == {}


def test_sigma_at_its_floor_and_without_one():
    for algorithm in (PGPE(sigma_floor=0.01), ES(initial_sigma=10.0)):
        texts = messages(np.linspace(0.0, 1.0, 30), algorithm, sigma_max=0.01)
        assert [(g, "sigma is down to 0.01" in each) for g, [each] in texts.items()] == [
            (WINDOW, True)
        ]
        assert messages(np.linspace(0.0, 1.0, 30), algorithm, sigma_max=0.0101) == {}


def test_equal_returns():
    texts = messages(np.linspace(0.0, 1.0, 30), return_min=7.0, return_max=7.0)
    assert [
        (g, "returned 7: no perturbation changes the reward" in each) for g, [each] in texts.items()
    ] == [(REPEATED, True)]


def test_rollouts_of_one_step():
    texts = messages(np.linspace(0.0, 1.0, 30), one_step=True, return_min=7.0, return_max=7.0)
    assert [(g, "ended in their first step" in each) for g, [each] in texts.items()] == [
        (REPEATED, True)
    ]
