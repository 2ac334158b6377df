"""The backends that peers.py compares: each gives a function that runs a generation, and a way to
kill a worker.
"""

import multiprocessing
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import evaluations
import numpy as np
from evaluations import evaluate, pid, theta

import farm
from farm.arrays import FloatArray
from farm.net.session import free_endpoint
from farm.runner import Runner
from farm.sim.engines import BatchEngine
from learner.pool.placement import Placement
from learner.run import setup
from learner.run.launch import Outputs, open_run

WORKERS: Final = 2

Kill = tuple[Callable[[], FloatArray], Callable[[], int]] | None
Generation = Callable[[str, int], object]
Opened = Iterator[tuple[Generation, Kill]]
Evaluate = Callable[[str, FloatArray], FloatArray]
"""Returns of all rows of a kind."""


def _pooled(call: Evaluate, victim: Callable[[], int] | None) -> tuple[Generation, Kill]:
    """The function that runs a generation of a kind and number of pairs, and how to kill a worker
    during one.
    """
    kill = None if victim is None else ((lambda: call("gait", theta("gait", 600))), victim)
    return (lambda kind, pairs: call(kind, theta(kind, 2 * pairs))), kill


def _halves(rows: FloatArray) -> list[FloatArray]:
    """Split rows into one part per worker; pairs stay together."""
    half = (len(rows) // 2 + 1) // 2 * 2
    return [rows[:half], rows[half:]]


@contextmanager
def of_threads() -> Opened:
    """Bare physics, two threads."""
    yield lambda kind, pairs: evaluations.physics(kind, 2 * pairs, WORKERS), None


@contextmanager
def of_processes() -> Opened:
    """Bare physics, two processes."""
    with multiprocessing.get_context("spawn").Pool(WORKERS) as pool:
        yield (
            lambda kind, pairs: pool.starmap(evaluations.physics, [(kind, pairs, 1)] * WORKERS, 1),
            None,
        )


@contextmanager
def of_loop() -> Opened:
    """The closed loop in this process without a farm, on two threads."""
    runners: dict[str, Runner] = {}

    def call(kind: str, rows: FloatArray) -> FloatArray:
        if kind == "zero":
            return evaluate(kind, rows)
        if kind not in runners:
            problem = setup.problem(evaluations.config(kind))
            runners[kind] = Runner(
                problem.task, problem.policy, lambda model: BatchEngine(model, 200, WORKERS)
            )
        return runners[kind].rollouts(rows, [(row // 2,) for row in range(len(rows))]).returns

    yield _pooled(call, None)


@contextmanager
def of_multiprocessing() -> Opened:
    """The standard library's pool."""
    with multiprocessing.get_context("spawn").Pool(WORKERS) as pool:
        victim = pool.map(pid, range(2), 1)[0]

        def call(kind: str, rows: FloatArray) -> FloatArray:
            return np.concatenate(
                pool.starmap(evaluate, [(kind, half) for half in _halves(rows)], 1)
            )

        yield _pooled(call, lambda: victim)


@contextmanager
def of_pipes(*, pinned: bool) -> Opened:
    """Two processes behind bare pipes, the least that a pool can be; pinned: each has its own
    core.
    """
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        ends = []
        for _ in range(WORKERS):
            end, other = context.Pipe()
            process = context.Process(target=evaluations.serve, args=(other,), daemon=True)
            process.start()
            if pinned:
                os.sched_setaffinity(
                    process.pid or 0, {sorted(os.sched_getaffinity(0))[len(ends) % WORKERS]}
                )
            stack.callback(process.kill)
            ends.append(end)

        def call(kind: str, rows: FloatArray) -> FloatArray:
            for end, half in zip(ends, _halves(rows), strict=True):
                end.send((kind, half))
            return np.concatenate([end.recv() for end in ends])

        yield _pooled(call, None)


@contextmanager
def of_joblib() -> Opened:
    """Joblib with its default, loky."""
    from joblib import Parallel, delayed

    with Parallel(n_jobs=WORKERS, max_nbytes=None) as pool:
        victim = pool(delayed(pid)(number) for number in range(2))[0]

        def call(kind: str, rows: FloatArray) -> FloatArray:
            return np.concatenate(pool(delayed(evaluate)(kind, half) for half in _halves(rows)))

        yield _pooled(call, lambda: victim)


@contextmanager
def of_ray() -> Opened:
    """Ray, with one actor per core."""
    import ray

    class Actor:
        def evaluate(self, kind: str, rows: FloatArray) -> FloatArray:
            return evaluate(kind, rows)

        def pid(self) -> int:
            return os.getpid()

    ray.init(num_cpus=WORKERS, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    actors = [ray.remote(Actor).remote() for _ in range(WORKERS)]

    def call(kind: str, rows: FloatArray) -> FloatArray:
        halves = zip(actors, _halves(rows), strict=True)
        return np.concatenate(
            ray.get([actor.evaluate.remote(kind, half) for actor, half in halves])
        )

    try:
        yield _pooled(call, lambda: ray.get(actors[0].pid.remote()))
    finally:
        ray.shutdown()


@contextmanager
def of_evotorch() -> Opened:
    """EvoTorch's PGPE, evaluated on its Ray actors."""
    import ray
    import torch
    from evotorch import Problem
    from evotorch.algorithms import PGPE

    ray.init(num_cpus=WORKERS, include_dashboard=False, log_to_driver=False, logging_level="ERROR")

    def search(kind: str, pairs: int) -> Any:  # noqa: ANN401
        middle = float(evaluations.STILL) if kind == "gait" else 0.0
        learnt = Problem(
            "max",
            lambda batch: torch.as_tensor(evaluate(kind, batch.numpy())),
            vectorized=True,
            num_actors=WORKERS,
            solution_length=evaluations.runner(kind).size,
            initial_bounds=(middle, middle),
            dtype=torch.float64,
        )
        rates = {"center_learning_rate": 0.0, "stdev_learning_rate": 0.0, "stdev_init": 0.02}
        return PGPE(learnt, popsize=2 * pairs, optimizer="sgd", **rates)

    searches: dict[tuple[str, int], Any] = {}

    def generation(kind: str, pairs: int) -> None:
        if (kind, pairs) not in searches:
            for other in searches.values():
                other.problem.kill_actors()
            searches.clear()
            searches[kind, pairs] = search(kind, pairs)
        searches[kind, pairs].step()

    try:
        yield generation, None
    finally:
        ray.shutdown()


@contextmanager
def of_dask() -> Opened:
    """Dask's distributed scheduler on this machine."""
    from distributed import Client

    with Client(
        n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR"
    ) as client:

        def call(kind: str, rows: FloatArray) -> FloatArray:
            return np.concatenate(
                client.gather(client.map(partial(evaluate, kind), _halves(rows), pure=False))
            )

        yield _pooled(call, lambda: next(iter(client.run(os.getpid).values())))


@contextmanager
def of_pool() -> Opened:
    """`farm.Farm`."""
    with ExitStack() as stack:
        pools: dict[str, farm.Farm] = {}

        def call(kind: str, rows: FloatArray) -> FloatArray:
            if kind not in pools:  # one pool at a time, so that there are only two workers
                stack.close()
                pools.clear()
                task, settings = evaluations.TASKS[kind]
                pools[kind] = stack.enter_context(farm.Farm(task, workers=WORKERS, **settings))
            return pools[kind].map(
                rows, [row // 2 for row in range(len(rows))] if kind != "zero" else None
            )

        yield _pooled(call, lambda: pools["gait"].worker_pids[0])


@contextmanager
def of_run(*, record: bool) -> Opened:
    """`farm run`: it learns, and records if wanted."""
    runs: dict[tuple[str, int], Any] = {}
    with tempfile.TemporaryDirectory() as folder:

        def reports(kind: str, pairs: int) -> Any:  # noqa: ANN401
            config = evaluations.config(kind, generations=100_000)
            still = {"learning_rate_mu": 0.0, "learning_rate_sigma": 0.0, "initial_sigma": 0.02}
            middle = {"initial_mu": evaluations.STILL} if kind == "gait" else {}
            algorithm = replace(config.algorithm_config, pairs=pairs, **still, **middle)
            place = Placement(workers=WORKERS, listen=free_endpoint())
            path = Path(folder) / secrets.token_hex(4)
            config = replace(config, algorithm_config=algorithm)
            with open_run(config, path, place, Outputs(record=record)) as run:
                yield from run.learn()

        def generation(kind: str, pairs: int) -> None:
            if (kind, pairs) not in runs:
                for other in runs.values():
                    other.close()
                runs.clear()
                runs[kind, pairs] = reports(kind, pairs)
            next(runs[kind, pairs])

        try:
            yield generation, None
        finally:
            for each in runs.values():
                each.close()


PHYSICS: Final = ("threads", "processes")
RUNS: Final = ("run", "recorded")
BACKENDS: Final[dict[str, tuple[str, str, Callable[[], Any]]]] = {
    "threads": ("physics alone, `mujoco.batch`, 2 threads", "mujoco", of_threads),
    "processes": ("physics alone, `mujoco.batch`, 2 processes", "mujoco", of_processes),
    "loop": ("closed loop, one process, 2 threads", "farm", of_loop),
    "pipes": (
        "two processes behind bare pipes",
        "multiprocessing",
        partial(of_pipes, pinned=False),
    ),
    "pinned": ("the same, each on its own core", "multiprocessing", partial(of_pipes, pinned=True)),
    "multiprocessing": ("multiprocessing.Pool(2)", "multiprocessing", of_multiprocessing),
    "joblib": ("joblib with loky, 2 jobs", "joblib", of_joblib),
    "ray": ("Ray, 2 actors", "ray", of_ray),
    "evotorch": ("EvoTorch's PGPE on Ray, 2 actors", "evotorch", of_evotorch),
    "dask": ("Dask, 2 workers", "distributed", of_dask),
    "pool": ("`farm.Farm`, 2 workers", "farm", of_pool),
    "run": ("`farm run --no-record`, 2 workers, learning", "farm", partial(of_run, record=False)),
    "recorded": (
        "`farm run`, as typed: learning and recording",
        "rerun",
        partial(of_run, record=True),
    ),
}
