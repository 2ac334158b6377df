"""Compares the farm with a process pool, Ray, EvoTorch on Ray, and Dask; one table.

    python benchmarks/peers.py [--turns 3] [--only NAME]

The backends run in turn, several times, each time in a separate process. All evaluate the same: generations of 15 and
of 100 mirrored pairs of the finger gait with perturbed starts, held still so that no rollout ends early, and
generations of empty evaluations. Their rate of physics steps is divided by that of MuJoCo alone with two threads,
measured in the same process just before and after. The other tools get each worker's half of a generation in one call,
which is fastest for them, and do not update or save anything. The time of `farm run` includes updates, checkpoints
and, as users type it, the recording. Tools that are not installed are left out: `pip install ray distributed evotorch`
installs all.
"""

import argparse
import importlib.util
import json
import multiprocessing
import os
import platform
import secrets
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import evaluations
import mujoco
import mujoco.batch
import numpy as np
from evaluations import STILL, gait, nothing, pid

import farm
from farm.arrays import FloatArray
from farm.net.session import free_endpoint
from farm.rollouts import Runner
from farm.sim.engines import BatchEngine
from farm.tasks.finger_gait.holding import CLOSING, SUBSTEPS
from farm.tasks.loop import Batch, again
from learner.run.config import RunConfig, configure
from learner.run.launch import Placement, open_run
from learner.run.setup import problem

PAIRS = (15, 100)
SECONDS = 1.0  # duration of each measurement
GIVE_UP = 10.0  # [s] after which an evaluation counts as hanging
ZERO = Path(__file__).with_name("zero_cost.py")

Evaluate = Callable[[Any, FloatArray], FloatArray]
"""Evaluates `gait` or `nothing` for all rows."""


def main() -> None:
    """Print the table; with --only, lines of JSON of one backend."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--only", choices=BACKENDS)
    parser.add_argument("--kill", action="store_true", help="with --only: kill a worker as well")
    parser.add_argument("--begun", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only:
        _of_one(arguments.only, arguments.begun or time.time(), kill=arguments.kill)
        return
    print(
        f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, MuJoCo {mujoco.__version__}"
    )
    there = {}
    for name, (what, package, _) in BACKENDS.items():
        if importlib.util.find_spec(package) is None:
            print(f"{what} is left out: {package} is not installed")
        else:
            there[name] = what
    turns = [{name: _turn(name, kill=turn == 0) for name in there} for turn in range(arguments.turns)]
    print(
        "\n| | 30 rollouts | 200 rollouts | 30 empty jobs [ms] | 200 [ms] | first result [s] | memory [MB] ",
        end="",
    )
    print("| if a worker is killed |\n|---|---|---|---|---|---|---|---|")
    for name, what in there.items():
        rows = [turn[name] for turn in turns]
        cells = [
            "-" if key not in rows[0] else f"{statistics.median(row[key] for row in rows):{form}}"
            for key, form in COLUMNS.items()
        ]
        print(f"| {what} | {' | '.join(cells)} | {rows[0].get('killed', '-')} |")


COLUMNS = {"gait15": ".2f", "gait100": ".2f", "zero15": ".2f", "zero100": ".2f", "first": ".1f", "memory": ".0f"}


def _turn(name: str, *, kill: bool) -> dict[str, Any]:
    """Run one backend in a separate process; return its results."""
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, __file__, "--only", name, "--begun", str(time.time())]
    command += ["--kill"] if kill else []
    said: dict[str, Any] = {}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True, env={**os.environ, "PYTHONPATH": path}
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("{"):
                    said |= json.loads(line)
        except KeyboardInterrupt:
            os.killpg(process.pid, signal.SIGKILL)  # Ctrl-C does not reach a session of its own
            raise
    print(name, json.dumps(said), file=sys.stderr, flush=True)
    return said


def _say(**values: object) -> None:
    print(json.dumps(values), flush=True)


def _of_one(name: str, begun: float, *, kill: bool) -> None:
    os.environ["TOKENIZERS_PARALLELISM"] = "false"
    with BACKENDS[name][2]() as (generation, killed):
        generation("zero", 15)
        _say(first=time.time() - begun)
        generation("gait", 15)
        _say(memory=_memory())
        for pairs in PAIRS:
            _say(**{f"zero{pairs}": 1e3 * statistics.median(_times(lambda: generation("zero", pairs)))})  # noqa: B023
        before = _physics()
        rates = {}
        for pairs in PAIRS:
            taken = _times(lambda: generation("gait", pairs))  # noqa: B023
            rates[pairs] = _steps(pairs, mean=name == "run") / statistics.mean(taken)
        physics = (before + _physics()) / 2
        _say(**{f"gait{pairs}": rate / physics for pairs, rate in rates.items()})
        if kill and killed is not None:
            _say(killed=f"it hangs (given up after {GIVE_UP:.0f} s)")
            _killed(*killed)


def _times(call: Callable[[], object]) -> list[float]:
    """Durations of repeated calls [s], without the first."""
    call()
    taken: list[float] = []
    while sum(taken) < SECONDS:
        begun = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begun)
    return taken


def _steps(pairs: int, *, mean: bool) -> int:
    """Physics steps of a generation, including those that close the grip before each start."""
    return (2 * pairs + mean) * configured().steps * SUBSTEPS + (pairs + mean) * CLOSING


def configured() -> Any:  # noqa: ANN401  the finger gait
    """The task."""
    return evaluations.runner().task


def _physics() -> float:
    """Physics steps per second of MuJoCo alone, two threads, from the gait's start."""
    sim, count, steps = evaluations.runner().sim, 64, 200
    again(lambda: Batch(configured(), sim, [(row // 2,) for row in range(count)]))
    bare = mujoco.batch.Batch(sim.model, count, 2)
    for name in ("qpos", "qvel", "ctrl", "eq_active", "mocap_pos", "mocap_quat"):
        bare.bind(name)[:] = getattr(sim, name)
    return count * steps / statistics.mean(_times(lambda: bare.step(nstep=steps)))


def _memory() -> float:
    """Proportional set size of this process and all its descendants [MB]."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except OSError:
                continue
    family, size = {os.getpid()}, 0
    while len(family) > size:
        size = len(family)
        family |= {child for child, parent in parents.items() if parent in family}
    total = 0
    for each in family:
        try:
            lines = Path(f"/proc/{each}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


def _killed(evaluate: Callable[[], FloatArray], victim: Callable[[], int]) -> None:
    """Kill a worker during an evaluation, and print what happens."""
    before = time.perf_counter()
    alone = evaluate()
    undisturbed = time.perf_counter() - before
    signal.signal(signal.SIGALRM, lambda *_: os.killpg(0, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, GIVE_UP)
    killer = subprocess.Popen(["/bin/sh", "-c", f"sleep {0.4 * undisturbed}; kill -9 {victim()}"])
    before = time.perf_counter()
    try:
        found = evaluate()
    except Exception as error:
        _say(killed=type(error).__name__)
        return
    seconds = time.perf_counter() - before
    killer.wait()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    same = "the same returns" if np.array_equal(found, alone) else "different returns"
    _say(killed=f"{same}, {seconds - undisturbed:+.1f} s")


# ---------------------------------------------------------------- backends

Kill = tuple[Callable[[], FloatArray], Callable[[], int]] | None
Opened = Iterator[tuple[Callable[[str, int], object], Kill]]


def _theta(rows: int) -> FloatArray:
    return STILL + 0.02 * np.random.default_rng(0).standard_normal((rows, evaluations.runner().size))


def _pooled(evaluate: Evaluate, victim: Callable[[], int] | None) -> tuple[Callable[[str, int], object], Kill]:
    """Return the function that runs a generation of a kind and number of pairs, and how to kill a worker during one."""
    what = {"gait": gait, "zero": nothing}
    thetas = {pairs: _theta(2 * pairs) for pairs in (*PAIRS, 300)}
    kill = None if victim is None else ((lambda: evaluate(gait, thetas[300])), victim)
    return lambda kind, pairs: evaluate(what[kind], thetas[pairs]), kill


def _halves(theta: FloatArray) -> list[FloatArray]:
    """Split rows into one part per worker; pairs stay together."""
    half = (len(theta) // 2 + 1) // 2 * 2
    return [theta[:half], theta[half:]]


@contextmanager
def of_loop() -> Opened:
    """The closed loop in this process without a farm, on two threads."""
    found = problem(configure())
    own = Runner(found.task, found.policy, lambda model: BatchEngine(model, 200, 2))

    def evaluate(what: Any, theta: FloatArray) -> FloatArray:  # noqa: ANN401
        return own.rollouts(theta, [(row // 2,) for row in range(len(theta))]).returns if what is gait else what(theta)

    yield _pooled(evaluate, None)


@contextmanager
def of_multiprocessing() -> Opened:
    """The standard library's pool."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        victim = pool.map(pid, range(2), 1)[0]
        yield _pooled(lambda what, theta: np.concatenate(pool.map(what, _halves(theta), 1)), lambda: victim)


@contextmanager
def of_ray() -> Opened:
    """Ray, with one actor per core."""
    import ray

    class Actor:
        def evaluate(self, what: Any, theta: FloatArray) -> FloatArray:  # noqa: ANN401
            return what(theta)

        def pid(self) -> int:
            return os.getpid()

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    actors = [ray.remote(Actor).remote() for _ in range(2)]

    def evaluate(what: Any, theta: FloatArray) -> FloatArray:  # noqa: ANN401
        halves = zip(actors, _halves(theta), strict=True)
        return np.concatenate(ray.get([actor.evaluate.remote(what, half) for actor, half in halves]))

    try:
        yield _pooled(evaluate, lambda: ray.get(actors[0].pid.remote()))
    finally:
        ray.shutdown()


@contextmanager
def of_evotorch() -> Opened:
    """EvoTorch's PGPE, evaluated on its Ray actors."""
    import ray
    import torch
    from evotorch import Problem
    from evotorch.algorithms import PGPE

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")

    def search(what: Any, pairs: int) -> Any:  # noqa: ANN401
        problem = Problem(
            "max", lambda batch: torch.as_tensor(what(batch.numpy())), vectorized=True, num_actors=2,
            solution_length=evaluations.runner().size, initial_bounds=(STILL, STILL), dtype=torch.float64,
        )  # fmt: skip
        rates = {"center_learning_rate": 0.0, "stdev_learning_rate": 0.0, "stdev_init": 0.02}
        return PGPE(problem, popsize=2 * pairs, optimizer="sgd", **rates)

    searches: dict[tuple[str, int], Any] = {}

    def generation(kind: str, pairs: int) -> None:
        if (kind, pairs) not in searches:
            searches[kind, pairs] = search({"gait": gait, "zero": nothing}[kind], pairs)
        searches[kind, pairs].step()

    try:
        yield generation, None
    finally:
        ray.shutdown()


@contextmanager
def of_dask() -> Opened:
    """Dask's distributed scheduler on this machine."""
    from distributed import Client

    with Client(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR") as client:

        def evaluate(what: Any, theta: FloatArray) -> FloatArray:  # noqa: ANN401
            return np.concatenate(client.gather(client.map(what, _halves(theta), pure=False)))

        yield _pooled(evaluate, lambda: next(iter(client.run(os.getpid).values())))


@contextmanager
def of_pool() -> Opened:
    """`farm.Farm`."""
    with ExitStack() as stack:
        pools: dict[Any, farm.Farm] = {}

        def evaluate(what: Any, theta: FloatArray) -> FloatArray:  # noqa: ANN401
            if what not in pools:  # one pool at a time, so that there are only two workers
                stack.close()
                pools.clear()
                own = ("finger-gait", {"preset": "default"}) if what is gait else (f"{ZERO}:ZeroCost", _LINEAR)
                pools[what] = stack.enter_context(farm.Farm(own[0], workers=2, **own[1]))
            pool = pools[what]
            return pool.map(theta[:, : pool.size], [row // 2 for row in range(len(theta))] if what is gait else None)

        yield _pooled(evaluate, lambda: pools[gait].worker_pids[0])


_LINEAR: Any = {"policy": "linear"}


@contextmanager
def of_run(*, record: bool) -> Opened:
    """`farm run`: it learns, and records if wanted."""
    runs: dict[tuple[str, int], Any] = {}
    with tempfile.TemporaryDirectory() as folder:

        def begun(kind: str, pairs: int) -> Any:  # noqa: ANN401
            place = Placement(workers=2, listen=free_endpoint(), record=record)
            with open_run(_config(kind, pairs), Path(folder) / secrets.token_hex(4), place) as run:
                yield from run.learn()

        def generation(kind: str, pairs: int) -> None:
            if (kind, pairs) not in runs:
                for other in runs.values():
                    other.close()
                runs.clear()
                runs[kind, pairs] = begun(kind, pairs)
            next(runs[kind, pairs])

        try:
            yield generation, None
        finally:
            for each in runs.values():
                each.close()


def _config(kind: str, pairs: int) -> RunConfig:
    rates = {"learning_rate_mu": 0.0, "learning_rate_sigma": 0.0, "initial_sigma": 0.02}
    if kind == "zero":
        return configure(f"{ZERO}:ZeroCost", policy="linear", pairs=pairs, generations=100_000)
    config = configure()
    still = replace(config.algorithm_config, pairs=pairs, initial_mu=STILL, **rates)
    return replace(config, algorithm_config=still, generations=100_000)


BACKENDS = {
    "loop": ("closed loop, one process, 2 threads", "farm", of_loop),
    "multiprocessing": ("multiprocessing.Pool(2)", "multiprocessing", of_multiprocessing),
    "ray": ("Ray, 2 actors", "ray", of_ray),
    "evotorch": ("EvoTorch's PGPE on Ray, 2 actors", "evotorch", of_evotorch),
    "dask": ("Dask, 2 workers", "distributed", of_dask),
    "pool": ("`farm.Farm`, 2 workers", "farm", of_pool),
    "run": ("`farm run --no-record`, 2 workers, learning", "farm", partial(of_run, record=False)),
    "recorded": ("`farm run`, 2 workers, learning and recording", "rerun", partial(of_run, record=True)),
}


if __name__ == "__main__":
    from running import script

    script(main)
