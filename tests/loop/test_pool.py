"""A pool of workers for search methods of one's own: real processes over loopback."""

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import farm
from farm.arrays import FloatArray
from farm.net.session import free_endpoint, listen
from learner.config import configure
from learner.setup import problem
from workers.worker import WorkerConfig, work

COUNT = 24


@pytest.fixture(scope="module")
def pool() -> Iterator[farm.Farm]:
    with farm.Farm("finger-gait", policy="linear", workers=2) as opened:
        yield opened


@pytest.fixture(scope="module")
def thetas() -> FloatArray:
    return 0.1 * np.random.default_rng(0).standard_normal((COUNT, 72))


@pytest.fixture(scope="module")
def alone(thetas: FloatArray) -> FloatArray:
    """The same evaluations in this process."""
    runner = problem(configure("finger-gait", policy="linear")).runner()
    found = runner.rollouts(thetas, [(4, 0, i, 0) for i in range(COUNT)]).returns
    runner.close()
    return found


def test_returns_are_in_order_and_the_same_bits_as_in_one_process(
    pool: farm.Farm, thetas: FloatArray, alone: FloatArray
) -> None:
    assert pool.size == 72
    assert pool.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
    came = list(pool.imap(thetas, seeds=range(COUNT)))
    assert sorted(came) == list(enumerate(alone.tolist()))
    assert pool.map([]).shape == (0,)


def test_a_worker_that_is_killed_changes_nothing(pool: farm.Farm, thetas: FloatArray, alone: FloatArray) -> None:
    results = pool.imap(thetas, seeds=range(COUNT))
    found = [next(results)]
    os.kill(pool.worker_pids[0], signal.SIGKILL)
    found += results
    assert sorted(found) == list(enumerate(alone.tolist()))


def test_a_rollout_shows_its_channels(pool: farm.Farm, thetas: FloatArray, alone: FloatArray) -> None:
    shown = pool.rollout(thetas[3], seed=3)
    assert shown.value == alone[3]
    assert shown.channels["tactile"].shape[1:] == (3, 6, 3)
    assert pool.rollout(thetas[3]).value == pool.map(thetas[3:4])[0]


def test_two_threads_take_turns(pool: farm.Farm, thetas: FloatArray, alone: FloatArray) -> None:
    with ThreadPoolExecutor(2) as threads:
        halves = [threads.submit(pool.map, thetas[i::2], range(i, COUNT, 2)) for i in range(2)]
        for i, half in enumerate(halves):
            assert half.result(60).tobytes() == alone[i::2].tobytes()


def test_it_uses_the_workers_of_a_farm_that_stands(thetas: FloatArray, alone: FloatArray) -> None:
    endpoint, stop = free_endpoint(), threading.Event()
    worker = threading.Thread(target=work, args=(WorkerConfig(connect=(endpoint,), name="w"), stop.is_set))
    with listen(endpoint, "farm"):
        worker.start()
        try:
            with farm.Farm("finger-gait", policy="linear", connect=endpoint) as joined:
                assert not joined.worker_pids
                assert joined.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
        finally:
            stop.set()
            worker.join(30)


@pytest.mark.parametrize(
    ("thetas", "seeds", "said"),
    [
        ([1.0], None, r"thetas has shape \(1,\); expected \(B, 72\)"),
        (np.zeros((2, 3)), None, r"thetas has shape \(2, 3\); expected \(B, 72\)"),
        ([["a"] * 72], None, r"thetas is a list; expected numbers of shape \(B, 72\)"),
        (np.full((2, 72), np.nan), None, r"thetas\[0\] is not finite"),
        (np.zeros((2, 72)), [1], "there are 1 seeds; expected 2"),
        (np.zeros((1, 72)), [-1], "seed '-1'; expected a whole number from 0"),
        (np.zeros((1, 72)), [0.5], "seed '0.5'; expected a whole number from 0"),
        (np.zeros((1, 72)), [2**32], "expected a whole number from 0 to 4294967295"),
    ],
)
def test_arrays_that_do_not_fit(pool: farm.Farm, thetas: object, seeds: object, said: str) -> None:
    with pytest.raises(farm.ConfigError, match=said):
        pool.map(thetas, seeds)  # type: ignore[arg-type]


def test_no_workers_at_all() -> None:
    with pytest.raises(farm.ConfigError, match="workers is 0; expected 1 or more"):
        farm.Farm("finger-gait", workers=0)


def test_closing_ends_whoever_waits(thetas: FloatArray) -> None:
    pool = farm.Farm("finger-gait", policy="linear", workers=1)
    ended = threading.Event()

    def ask() -> None:
        try:
            while True:
                pool.map(thetas)
        except farm.RunError:
            ended.set()

    thread = threading.Thread(target=ask)
    thread.start()
    pool.close()
    thread.join(30)
    assert ended.is_set()
    with pytest.raises(farm.RunError, match="the pool is closed"):
        pool.map(thetas)
