"""Jobs as one table: parameters, seeds and kinds of their rollouts, some of them, and results that
name them.
"""

import numpy as np
import pytest
from messages import EPS, HEAD, JOBS, RNG, SEEDS, WIRE, P

from farm.net import codec
from farm.net.work import Chunk, Jobs, Results, Simulated, rows_with_trace


def test_parameters_and_seeds_of_jobs():
    mu = RNG.normal(size=P)
    assert JOBS.indices.tolist() == [0, 1, 2, 3, 4, 5]
    assert JOBS.rollouts.tolist() == [2, 2, 2, 1, 1, 1]
    assert JOBS.seen.tolist() == [False, False, False, True, True, True]
    assert JOBS.physics.tolist() == [False] * 5 + [True]
    expected = [*(mu + sign * eps for eps in EPS for sign in (1, -1)), mu, mu, EPS[0]]
    assert JOBS.theta(mu).tobytes() == np.array(expected).tobytes()
    pairs = [seed for seed in SEEDS for _ in range(2)]
    assert JOBS.seeds() == [*pairs, None, (9, 9, 9, 9), (3, 0, 4, 1)]


def test_jobs_without_eps_and_of_one_sign():
    mu, eps = RNG.normal(size=P), RNG.normal(size=(2, P))
    assert Jobs.mean("none", [None, SEEDS[0]]).theta(mu).tolist() == [mu.tolist()] * 2
    single = Jobs.exploring(eps, (-1,), None)
    assert single.theta(mu).tobytes() == (mu - eps).tobytes()
    assert single.seeds() == [None, None]
    assert not single.seen.any()
    means_first = Jobs.joined([Jobs.mean("control", [None]), Jobs.exploring(eps, (1, -1), None)])
    assert (
        means_first.theta(mu)[[0, 1, 4]].tobytes()
        == np.array([mu, mu + eps[0], mu - eps[1]]).tobytes()
    )


@pytest.mark.parametrize(
    "indices", [[0], [3], [5], [1, 2], [3, 4], [0, 1, 2, 3, 4, 5], [0, 2], [5, 1], [4, 1, 5, 0]]
)
def test_some_jobs_are_the_same_jobs(indices):
    mu, subset = RNG.normal(size=P), JOBS.take(indices)
    starts = np.cumsum(JOBS.rollouts) - JOBS.rollouts
    rows = [row for job in indices for row in range(starts[job], starts[job] + JOBS.rollouts[job])]
    assert subset.indices.tolist() == indices
    assert subset.theta(mu).tobytes() == JOBS.theta(mu)[rows].tobytes()
    assert subset.seeds() == [JOBS.seeds()[row] for row in rows]
    back = codec.decode(codec.encode(Chunk.carrying(subset, **HEAD)), Chunk).take(
        range(len(indices))
    )
    assert back.theta(mu).tobytes() == subset.theta(mu).tobytes()


def test_results_carry_the_jobs_indices():
    outcome = Simulated(
        returns=np.arange(3.0),
        flags=np.zeros((3, 4), bool),
        steps=np.ones(3, "<i8"),
        traces=np.zeros((0, 0, 0), "<f4"),
        trajectories=(WIRE,),
    )
    results = Results.carrying(outcome, JOBS.take([1, 3]), 0.5, **HEAD, worker="w/1")
    assert codec.decode(codec.encode(results), Results).jobs.tolist() == [1, 3]


@pytest.mark.parametrize(
    ("returns", "expected"),
    [([0.5, 2.0, -1.0, 1.0], [1, 2]), ([1.0, 2.0, 2.0, 1.0], [0, 1]), ([3.0] * 4, [0])],
)
def test_traces_of_the_best_and_the_worst(returns, expected):
    returns, exploring = np.array([9.0, *returns]), np.array([False, True, True, True, True])
    assert rows_with_trace("extremes", returns, exploring).tolist() == [1 + row for row in expected]
    assert rows_with_trace("all", returns, exploring).tolist() == [1, 2, 3, 4]
    assert not rows_with_trace("none", returns, exploring).size
    assert not rows_with_trace("extremes", returns, np.zeros(5, bool)).size
