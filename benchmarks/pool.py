"""The pool beside multiprocessing.Pool, Ray and Dask: start-up, overhead of a call, and what a killed worker does.

    python benchmarks/pool.py [--calls 300] [--only farm]

Two workers each, in a process of its own. A call has 30 short vectors that take no time: the farm simulates one step of
one body for each, the others add the numbers up. Then 200 evaluations of 20 ms (the farm: 400 rollouts of the finger
gait), in the middle of which one of the two workers is killed. What is not installed is left out, and said.
"""

import argparse
import importlib.util
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

CALL, SLOW, SECONDS = 30, 200, 0.02
GIVE_UP = 30.0  # [s] after which a call that does not return counts as hanging
NEEDS = {"farm": "farm", "multiprocessing": "multiprocessing", "ray": "ray", "dask": "distributed"}
NAMES = {"farm": "farm.Farm", "multiprocessing": "multiprocessing.Pool", "ray": "Ray", "dask": "Dask"}
Evaluate = Callable[[np.ndarray], list[float]]


def nothing(theta: np.ndarray) -> float:
    """An evaluation that takes no time."""
    return float(theta.sum())


def slow(theta: np.ndarray) -> float:
    """One that takes some."""
    time.sleep(SECONDS)
    return float(theta.sum())


def pid(_: int) -> int:
    """Where a worker runs."""
    time.sleep(0.2)
    return os.getpid()


def main() -> None:
    """Print the table; with --only, a line of JSON of one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--only", choices=NEEDS)
    arguments = parser.parse_args()
    if arguments.only:
        {"farm": of_farm, "multiprocessing": of_multiprocessing, "ray": of_ray, "dask": of_dask}[arguments.only](
            arguments.calls
        )
        return
    print(
        f"| {CALL} vectors, 2 workers | start to the first values [s] | a call, median [ms] | 10 to 90 % | one killed |"
    )
    print("|---|---|---|---|---|")
    for name, package in NEEDS.items():
        if importlib.util.find_spec(package) is None:
            print(f"{NAMES[name]} is left out: {package} is not installed", file=sys.stderr)
            continue
        command = [sys.executable, __file__, "--only", name, "--calls", str(arguments.calls)]
        said = {"killed": f"it hangs (given up after {GIVE_UP:.0f} s)"}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("{"):
                    said |= json.loads(line)
        low, middle, high = said["calls"]
        print(f"| {NAMES[name]} | {said['start']:.1f} | {middle:.2f} | {low:.2f} to {high:.2f} | {said['killed']} |")


def say(**values: object) -> None:
    """A part of the row, for the process that prints it."""
    print(json.dumps(values), flush=True)


def measure(begun: float, calls: int, evaluate: Evaluate) -> None:
    """Start-up and overhead."""
    thetas = np.random.default_rng(0).standard_normal((CALL, 4))
    evaluate(thetas)
    say(start=time.perf_counter() - begun)
    taken = []
    for _ in range(calls):
        before = time.perf_counter()
        evaluate(thetas)
        taken.append(1e3 * (time.perf_counter() - before))
    say(calls=np.percentile(taken[calls // 10 :], [10, 50, 90]).tolist())


def kill(evaluate: Evaluate, victim: int, thetas: np.ndarray) -> None:
    """Evaluate, then again with a worker killed a moment after the beginning; never returns where the call hangs."""
    before = time.perf_counter()
    alone = evaluate(thetas)
    undisturbed = time.perf_counter() - before
    killer = multiprocessing.get_context("spawn").Process(target=_kill, args=(victim, 0.4 * undisturbed))
    killer.start()  # takes some tenths of a second itself, in the middle of what follows
    signal.signal(signal.SIGALRM, lambda *_: os.killpg(0, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, GIVE_UP)
    before = time.perf_counter()
    try:
        found = evaluate(thetas)
    except Exception as error:
        say(killed=f"{type(error).__name__}")
        return
    seconds = time.perf_counter() - before
    killer.join()
    same = "the same array" if np.array_equal(found, alone) else "another array"
    say(killed=f"{same} in {seconds:.1f} s ({undisturbed:.1f} s undisturbed)")


def _kill(victim: int, after: float) -> None:
    time.sleep(after)
    os.kill(victim, signal.SIGKILL)


def of_farm(calls: int) -> None:
    """Ours."""
    begun = time.perf_counter()
    import farm

    with farm.Farm(f"{Path(__file__).with_name('zero_cost.py')}:ZeroCost", policy="linear", workers=2) as pool:
        measure(begun, calls, lambda thetas: pool.map(thetas[:, : pool.size]).tolist())
    with farm.Farm("finger-gait", policy="linear", workers=2) as pool:
        thetas = 0.01 * np.random.default_rng(0).standard_normal((2 * SLOW, pool.size))
        pool.map(thetas[:10])
        kill(lambda given: pool.map(given).tolist(), pool.worker_pids[0], thetas)


def of_multiprocessing(calls: int) -> None:
    """The standard library's."""
    begun = time.perf_counter()
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        measure(begun, calls, lambda thetas: pool.map(nothing, thetas))
        thetas = np.random.default_rng(0).standard_normal((SLOW, 4))
        kill(lambda given: pool.map(slow, given), pool.map(pid, range(2))[0], thetas)


def of_ray(calls: int) -> None:
    """Ray on this machine."""
    begun = time.perf_counter()
    import ray

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    quick, slowly, where = ray.remote(nothing), ray.remote(slow), ray.remote(pid)
    measure(begun, calls, lambda thetas: ray.get([quick.remote(theta) for theta in thetas]))
    victim = ray.get(where.remote(0))
    thetas = np.random.default_rng(0).standard_normal((SLOW, 4))
    kill(lambda given: ray.get([slowly.remote(theta) for theta in given]), victim, thetas)
    ray.shutdown()


def of_dask(calls: int) -> None:
    """Dask's distributed scheduler on this machine."""
    begun = time.perf_counter()
    from distributed import Client

    with Client(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR") as client:

        def evaluate(thetas: np.ndarray) -> list[float]:
            return client.gather(client.map(nothing, list(thetas), pure=False))

        measure(begun, calls, evaluate)
        victim = next(iter(client.run(os.getpid).values()))
        thetas = np.random.default_rng(0).standard_normal((SLOW, 4))
        kill(lambda given: client.gather(client.map(slow, list(given), pure=False)), victim, thetas)


if __name__ == "__main__":
    main()
