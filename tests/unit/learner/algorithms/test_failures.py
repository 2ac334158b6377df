"""A failed rollout does not decide an update: what each algorithm does with one, and with nothing
else.
"""

import numpy as np
import pytest
from test_others import OTHERS

from farm.returns import RETURN_FLOOR, penalised
from learner import algorithms
from learner.algorithms import PGPE

P = 50
ALL = OTHERS | {
    f"pgpe {estimator} {normaliser} {baseline}": PGPE(
        pairs=16, estimator=estimator, normaliser=normaliser, baseline=baseline, initial_mu=0.0
    )
    for estimator in ("symmetric", "plain")
    for normaliser in ("sehnke", "thesis")
    for baseline in ("moving-average", "optimal", "none")
}


def told(algorithm, failed):
    """eps, returns of a linear function with some of them failed, and the state after two updates
    with them.
    """
    state = algorithm.init(P)
    slope = np.random.default_rng(1).normal(size=P)
    for generation in range(2):
        eps = algorithms.ask(algorithm, state, np.random.default_rng(generation))
        returns = np.stack([(state.mu + sign * eps) @ slope for sign in algorithm.signs()], axis=1)
        returns.ravel()[list(failed)] = RETURN_FLOOR
        before, state = state, algorithms.tell(algorithm, state, eps, returns)
    return before, state, eps, returns


@pytest.mark.parametrize("name", ALL)
def test_one_failure_of_a_generation_decides_nothing(name):
    before, after, eps, returns = told(ALL[name], [3])
    row, column = divmod(3, returns.shape[1])
    step = after.mu - before.mu
    cosine = step @ eps[row] / np.linalg.norm(step) / np.linalg.norm(eps[row])
    assert abs(cosine) < 0.9
    assert after.baseline is None or abs(after.baseline) < 1e3, "of returns of some ten"
    assert penalised(returns)[row, column] == penalised(returns).min()


@pytest.mark.parametrize("name", ALL)
def test_a_generation_of_failures_moves_nothing(name):
    algorithm = ALL[name]
    state = algorithm.init(P)
    eps = algorithms.ask(algorithm, state, np.random.default_rng(0))
    returns = np.full((len(eps), len(algorithm.signs())), RETURN_FLOOR)
    after = algorithms.tell(algorithm, state, eps, returns)
    changed = {
        name
        for name, value in after.to_dict().items()
        if not np.array_equal(value, state.to_dict()[name])
    }
    assert changed == {"generation"}
