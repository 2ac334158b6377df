"""A pool of workers for the user's own search method: real processes over loopback."""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import farm
from farm.arrays import FloatArray
from farm.commands import certificates
from farm.net.session import free_endpoint, listen
from farm.net.tls import find
from learner.pool import pool as pools
from learner.pool.placement import Placement
from learner.run.config import configure
from learner.run.launch import open_run
from learner.run.setup import problem
from workers.config import WorkerConfig
from workers.worker import work

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
    returns = runner.rollouts(thetas, [(4, 0, i, 0) for i in range(COUNT)]).returns
    runner.close()
    return returns


def test_returns_are_in_order_and_the_same_bits_as_in_one_process(
    pool: farm.Farm, thetas: FloatArray, alone: FloatArray
) -> None:
    assert pool.size == 72
    assert pool.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
    came = list(pool.imap(thetas, seeds=range(COUNT)))
    assert sorted(came) == list(enumerate(alone.tolist()))
    assert pool.map([]).shape == (0,)


def test_a_worker_that_is_killed_changes_nothing(
    pool: farm.Farm, thetas: FloatArray, alone: FloatArray
) -> None:
    results = pool.imap(thetas, seeds=range(COUNT))
    pairs = [next(results)]
    os.kill(pool.worker_pids[0], signal.SIGKILL)
    pairs += results
    assert sorted(pairs) == list(enumerate(alone.tolist()))


@pytest.mark.slow
def test_two_of_three_workers_that_are_killed_change_nothing(
    thetas: FloatArray, alone: FloatArray
) -> None:
    with farm.Farm("finger-gait", policy="linear", workers=3) as pool:
        assert pool.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
        many = np.tile(thetas, (6, 1))
        results = pool.imap(many, seeds=np.tile(np.arange(COUNT), 6))
        returns = dict([next(results)])
        for pid in pool.worker_pids[:2]:
            os.kill(pid, signal.SIGKILL)
        returns |= dict(results)
        assert [returns[i] for i in range(len(many))] == np.tile(alone, 6).tolist()


def test_an_abandoned_imap_does_not_block_other_calls(
    pool: farm.Farm, thetas: FloatArray, alone: FloatArray
) -> None:
    for index, value in pool.imap(thetas, seeds=range(COUNT)):
        assert value == alone[index]
        break  # what is out is void
    results = pool.imap(thetas, seeds=range(COUNT))
    next(results)
    with pytest.raises(
        farm.RunError,
        match=r"an imap of this thread has not ended: take its last pair, or close\(\)",
    ):
        pool.map(thetas)
    results.close()  # type: ignore[attr-defined]
    assert pool.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()


def test_a_rollout_shows_its_channels(
    pool: farm.Farm, thetas: FloatArray, alone: FloatArray
) -> None:
    trajectory = pool.rollout(thetas[3], seed=3)
    assert trajectory.value == alone[3]
    assert trajectory.channels["tactile"].shape[1:] == (3, 6, 3)
    assert pool.rollout(thetas[3]).value == pool.map(thetas[3:4])[0]


def test_two_threads_take_turns(pool: farm.Farm, thetas: FloatArray, alone: FloatArray) -> None:
    with ThreadPoolExecutor(2) as threads:
        halves = [threads.submit(pool.map, thetas[i::2], range(i, COUNT, 2)) for i in range(2)]
        for i, half in enumerate(halves):
            assert half.result(60).tobytes() == alone[i::2].tobytes()


@pytest.mark.slow
def test_it_uses_the_workers_of_a_farm_that_stands(thetas: FloatArray, alone: FloatArray) -> None:
    endpoint, stop = free_endpoint(), threading.Event()
    worker = threading.Thread(
        target=work, args=(WorkerConfig(connect=(endpoint,), name="w"), stop.is_set)
    )
    with listen(endpoint, "farm"):
        worker.start()
        try:
            with farm.Farm("finger-gait", policy="linear", connect=endpoint) as client:
                assert not client.worker_pids
                assert client.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
        finally:
            stop.set()
            worker.join(30)


@pytest.mark.parametrize(
    ("thetas", "seeds", "reason"),
    [
        ([1.0], None, r"thetas has shape \(1,\); expected \(B, 72\)"),
        (np.zeros((2, 3)), None, r"thetas has shape \(2, 3\); expected \(B, 72\)"),
        ([["a"] * 72], None, r"thetas is a list of str32; expected numbers of shape \(B, 72\)"),
        (np.zeros((2, 72), complex), None, "thetas is a ndarray of complex128; expected numbers"),
        ([[0.0] * 72, [0.0]], None, "thetas is a list that is not an array; expected numbers"),
        (None, None, "thetas is a NoneType of object; expected numbers"),
        (np.zeros((2, 72)), 3, "seeds is a int; expected 2 whole numbers"),
        (np.full((2, 72), np.nan), None, r"thetas\[0\] is not finite"),
        (np.zeros((2, 72)), [1], "there are 1 seeds; expected 2"),
        (np.zeros((1, 72)), [-1], "seed '-1'; expected a whole number from 0"),
        (np.zeros((1, 72)), [0.5], "seed '0.5'; expected a whole number from 0"),
        (np.zeros((1, 72)), [2**32], "expected a whole number from 0 to 4294967295"),
    ],
)
def test_arrays_that_do_not_fit(
    pool: farm.Farm, thetas: object, seeds: object, reason: str
) -> None:
    for call in (pool.map, pool.imap):
        with pytest.raises(farm.ConfigError, match=reason) as error:
            call(thetas, seeds)  # type: ignore[arg-type]
        assert "\n" not in str(error.value)


def test_names_and_numbers_that_no_farm_has() -> None:
    with pytest.raises(farm.ConfigError, match="farm 'a/b' is not a name"):
        farm.Farm("finger-gait", workers=1, farm="a/b")
    for workers in (1025, 1.5, "2"):
        with pytest.raises(farm.ConfigError, match=f"workers is {workers!r}; expected 1 to 1024"):
            farm.Farm("finger-gait", workers=workers)  # type: ignore[arg-type]
        with pytest.raises(farm.ConfigError, match=f"workers is {workers!r}; expected 1 to 1024"):
            list(farm.learn(farm.configure("finger-gait"), "never", workers=workers))  # type: ignore[arg-type]
    for connect in (5, [5], b"tcp/127.0.0.1:1"):
        with pytest.raises(
            farm.ConfigError, match=r"expected tcp/HOST:PORT or tls/HOST:PORT, or several of them"
        ):
            farm.Farm("finger-gait", connect=connect)  # type: ignore[arg-type]
    with pytest.raises(
        farm.ConfigError, match="workers is 0; expected 1 to 1024 processes on this machine"
    ):
        farm.Farm("finger-gait", workers=0)


def test_closing_ends_a_waiting_call(thetas: FloatArray) -> None:
    pool = farm.Farm("finger-gait", policy="linear", workers=1)
    over = threading.Event()

    def ask() -> None:
        try:
            while True:
                pool.map(thetas)
        except farm.RunError:
            over.set()

    thread = threading.Thread(target=ask)
    thread.start()
    pool.close()
    thread.join(30)
    assert over.is_set()
    with pytest.raises(farm.RunError, match="the pool is closed"):
        pool.map(thetas)


@pytest.mark.slow
def test_it_closes_with_an_imap_that_is_not_over(thetas: FloatArray) -> None:
    with farm.Farm("finger-gait", policy="linear", workers=1) as pool:
        results = pool.imap(thetas)
        next(results)
        (pid,) = pool.worker_pids
    assert not Path(f"/proc/{pid}").exists()
    pool.close()
    with pytest.raises(farm.RunError, match="the pool is closed"):
        list(results)


@pytest.mark.slow
def test_it_waits_and_says_so_while_no_worker_is_there(
    thetas: FloatArray, alone: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "_PATIENCE", 0.1)
    endpoint, stop, warnings = free_endpoint(), threading.Event(), queue.Queue[str]()
    worker = threading.Thread(
        target=work, args=(WorkerConfig(connect=(endpoint,), name="w"), stop.is_set)
    )
    monkeypatch.setattr(pools.log, "warning", lambda text, *values: warnings.put(text % values))
    with (
        listen(endpoint, "farm"),
        farm.Farm("finger-gait", policy="linear", connect=endpoint) as pool,
    ):
        with ThreadPoolExecutor(1) as thread:
            waits = thread.submit(pool.map, thetas, range(COUNT))
            assert (
                warnings.get(timeout=30)
                == f"no workers; start some with: farm worker --connect {endpoint}"
            )
            assert not waits.done()
            worker.start()
            try:
                assert waits.result(60).tobytes() == alone.tobytes()
            finally:
                stop.set()
                worker.join(30)


@pytest.mark.slow
def test_with_certificates(thetas: FloatArray, alone: FloatArray, tmp_path: Path) -> None:
    certificates.main(["new", str(tmp_path), "--learner", "127.0.0.1", "--worker", "w"])
    endpoint, stop = free_endpoint().replace("tcp/", "tls/"), threading.Event()
    config = WorkerConfig(connect=(endpoint,), tls=tmp_path / "worker-w")
    worker = threading.Thread(target=work, args=(config, stop.is_set))
    with listen(endpoint, "farm", find(tmp_path, "learner")):
        worker.start()
        try:
            with farm.Farm(
                "finger-gait", policy="linear", connect=endpoint, tls=tmp_path / "learner"
            ) as client:
                assert client.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
        finally:
            stop.set()
            worker.join(30)


_INTERRUPTED = """
import signal
import numpy as np
import farm

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
with farm.Farm("finger-gait", policy="linear", workers=2) as pool:
    try:
        while True:
            pool.map(np.zeros((50, 72)))
            print(*pool.worker_pids, flush=True)
    except KeyboardInterrupt:
        print(pool.map(np.zeros((1, 72))), flush=True)
        raise
"""


@pytest.mark.slow
def test_ctrl_c_ends_a_call_and_the_workers() -> None:
    script = subprocess.Popen(
        [sys.executable, "-c", _INTERRUPTED],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert script.stdout
    pids = script.stdout.readline().split()
    script.send_signal(signal.SIGINT)
    output, errors = script.communicate(timeout=60)
    assert script.returncode == -signal.SIGINT
    assert output.splitlines()[-1].startswith("["), "after Ctrl-C the pool is usable"
    assert errors.splitlines()[-1] == "KeyboardInterrupt"
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


_LEFT_OPEN = """
import sys
import numpy as np
import farm

pool = farm.Farm("finger-gait", policy="linear", workers=1)
pairs = pool.imap(np.zeros((3, 72)))
next(pairs)
print(*pool.worker_pids, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "status", "message"),
    [
        ("", 0, ""),
        ("del pool, pairs", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("raise ValueError('of the script')", 1, "ValueError: of the script"),
    ],
)
def test_a_script_that_closes_nothing_ends_and_its_workers_too(
    end: str, status: int, message: str
) -> None:
    script = subprocess.run(
        [sys.executable, "-c", _LEFT_OPEN + end],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert script.returncode == status
    assert script.stderr.rstrip().endswith(message)
    assert bool(script.stderr) == bool(message), "nothing else is said"
    assert not any(Path(f"/proc/{pid}").exists() for pid in script.stdout.split())


@pytest.mark.slow
def test_standing_workers_serve_it_beside_a_learner(
    thetas: FloatArray, alone: FloatArray, tmp_path: Path
) -> None:
    endpoint, stop = free_endpoint(), threading.Event()
    worker = threading.Thread(
        target=work, args=(WorkerConfig(connect=(endpoint,), name="w"), stop.is_set)
    )
    config = configure("finger-gait", generations=10_000)
    place = Placement(connect=(endpoint,))
    with (
        listen(endpoint, "farm"),
        open_run(config, tmp_path / "r", place, stopped=stop.is_set) as run,
    ):
        done = [0]

        def learn() -> None:
            for report in run.learn():
                done[0] = report.progress.rollouts

        learner = threading.Thread(target=learn)
        worker.start()
        learner.start()
        try:
            with farm.Farm("finger-gait", policy="linear", connect=endpoint) as pool:
                pool.map(thetas)
                before = done[0]
                for _ in range(10):
                    assert pool.map(thetas, seeds=range(COUNT)).tobytes() == alone.tobytes()
                learners = done[0] - before
        finally:
            stop.set()
            learner.join(60)
            worker.join(30)
    assert COUNT < learners < 40 * COUNT, "each has had its share of the worker"
