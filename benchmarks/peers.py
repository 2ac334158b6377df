"""Compares the farm with a process pool, joblib, Ray, EvoTorch on Ray, and Dask: two tables, and their numbers.

    python benchmarks/peers.py [--turns 10] [--names pool,run] [--out docs/results/tables/peers.json] [--table]

Each backend is a process that stays; they work in turns of about a second, one after another, because the speed of a
shared machine changes within seconds. All evaluate the same: generations of 15 and of 100 mirrored pairs of the finger
gait, held still so that no rollout ends early, and of the arm of examples/; and generations of empty evaluations. The
speed of a turn is that relative to the same physics steps by `mujoco.batch` with two threads in the same round of
turns; processor time is that of a backend's processes together, of which one is no worker. The other tools get each
worker's half of a generation in one call, which is fastest for them, and do not update or save anything. `farm run`
updates, saves and, as users type it, records; it also simulates its mean policy, which counts as a rollout. Tools that
are not installed are left out: `pip install ray distributed evotorch joblib` installs all.
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
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import evaluations
import mujoco
import numpy as np
from evaluations import evaluate, pid, theta

import farm
from farm.arrays import FloatArray
from farm.errors import FarmError
from farm.net.session import free_endpoint
from farm.rollouts import Runner
from farm.sim.engines import BatchEngine
from learner.run.launch import Placement, open_run
from learner.run.setup import problem

ROUNDS: Final = (("gait", 15), ("gait", 100), ("arm", 15), ("arm", 100), ("zero", 15), ("zero", 100))
"""Kinds of evaluations, and pairs of a generation."""
SECONDS: Final = 1.0  # of a turn
GIVE_UP: Final = 10.0  # [s] after which an evaluation counts as hanging
WORKERS: Final = 2


def main() -> None:
    """Measure what is asked for, and print the tables of the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--names", type=lambda text: text.split(","), default=list(BACKENDS))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", type=Path, help="print the tables of such a file, and measure nothing")
    parser.add_argument("--only", choices=BACKENDS, help=argparse.SUPPRESS)
    parser.add_argument("--begun", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only:
        _serve(arguments.only, arguments.begun)
        return
    if not arguments.table:
        found = _measured(arguments.turns, [name for name in BACKENDS if name in {"threads", *arguments.names}])
        if arguments.out:
            arguments.out.write_text(json.dumps(found, separators=(",", ":")) + "\n")
    else:
        found = json.loads(arguments.table.read_text())
    print("\n".join(table(found)))


def table(found: dict[str, Any]) -> Iterator[str]:
    """The lines of both tables: medians of the turns, lowest to highest in parentheses."""
    backends = found["backends"]
    kinds = [(f"{kind}{pairs}", f"{kind}, {2 * pairs}") for kind, pairs in ROUNDS if kind != "zero"]
    heads = [*(head for _, head in kinds), "core-ms at 30", "not its workers'", "30 empty [ms]", "200 [ms]",
             "first [s]", "MB", "a killed worker"]  # fmt: skip
    yield f"{found['machine']}; {found['turns']} turns"
    yield ""
    yield f"| | {' | '.join(heads)} |"
    yield "|---" * (len(heads) + 1) + "|"
    for name, own in backends.items():
        cells = [_spread(backends["threads"], own, key, _faster) for key, _ in kinds]
        cells += [f"{_median(own, 'gait15', part):.1f}" for part in ("cores", "own")]
        cells += [f"{_median(own, key, 'wall'):.2f}" if key in own["rounds"] else "-" for key in ("zero15", "zero100")]
        cells += [f"{own['first']:.1f}", f"{own['memory']:.0f}", own.get("killed", "-")]
        yield f"| {BACKENDS[name][0]} | {' | '.join(cells)} |"
    yield ""
    yield f"| ratio, turn by turn | {' | '.join(head for _, head in kinds)} |"
    yield "|---" * (len(kinds) + 1) + "|"
    for words, first, second, ratio in RATIOS:
        if first in backends and second in backends:
            cells = [_spread(backends[first], backends[second], key, ratio, 3) for key, _ in kinds]
            yield f"| {words} | {' | '.join(cells)} |"


def first_page(found: dict[str, Any]) -> Iterator[str]:
    """The rows of README's table."""
    backends = found["backends"]
    for name, own in backends.items():
        if name not in (*PHYSICS, "loop", "pipes", "pinned"):
            speeds = [_spread(backends["threads"], own, key, _faster).split()[0] for key in ("gait15", "gait100")]
            numbers = [f"{_median(own, 'zero15', 'wall'):.2g}", f"{own['first']:.1f}", f"{own['memory']:.0f}"]
            yield f"| {' | '.join([BACKENDS[name][0], *speeds, *numbers, own.get('killed', '-')])} |"


def _median(backend: dict[str, Any], key: str, part: str) -> float:
    return 1e3 * statistics.median(turn[part] for turn in backend["rounds"][key])


def _spread(first: dict[str, Any], second: dict[str, Any], key: str, ratio: "Ratio", digits: int = 2) -> str:
    turns = [ratio(*both) for both in zip(first["rounds"][key], second["rounds"][key], strict=True)]
    return f"{statistics.median(turns):.{digits}f} ({min(turns):.{digits}f} to {max(turns):.{digits}f})"


Ratio = Callable[[dict[str, float], dict[str, float]], float]
"""Of a turn of one backend and the turn of another in the same round."""


def _faster(first: dict[str, float], second: dict[str, float]) -> float:
    return first["wall"] / second["wall"]


def _workers(turn: dict[str, float]) -> float:
    return turn["cores"] - turn["own"]


RATIOS: Final[tuple[tuple[str, str, str, Ratio], ...]] = (
    ("speed of `farm.Farm` to bare pipes", "pipes", "pool", _faster),
    ("speed of `farm run`, as typed, to Pool(2)", "multiprocessing", "recorded", _faster),
    ("learner's processor time to its workers', not recording", "run", "run", lambda _, b: b["own"] / _workers(b)),
    ("the same, recording", "recorded", "recorded", lambda _, b: b["own"] / _workers(b)),
    ("workers' processor time, recording to not", "run", "recorded", lambda a, b: _workers(b) / _workers(a)),
)


def _measured(turns: int, names: list[str]) -> dict[str, Any]:
    there = {name: BACKENDS[name] for name in names if importlib.util.find_spec(BACKENDS[name][1])}
    for name in names:
        if name not in there:
            print(f"{BACKENDS[name][0]} is left out: {BACKENDS[name][1]} is not installed", file=sys.stderr)
    found: dict[str, Any] = {
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, "
        f"MuJoCo {mujoco.__version__}, {time.strftime('%Y-%m-%d')}",
        "turns": turns,
        "backends": {name: {"rounds": {}} for name in there},
    }
    with ExitStack() as stack:
        backends: dict[str, _Backend] = {}
        for name in there:  # one after another: the time of the first result counts
            backends[name] = stack.enter_context(_Backend(name))
            found["backends"][name] |= backends[name].ask("start")
        for kind, pairs in ROUNDS:
            able = {name: backend for name, backend in backends.items() if kind != "zero" or name not in PHYSICS}
            own = {name: [] for name in able}
            for backend in able.values():
                backend.ask(f"open {kind} {pairs}")
            for turn in range(turns):
                for name, backend in able.items():
                    own[name].append(backend.ask("turn"))
                print(f"{kind}, {pairs} pairs: {turn + 1} of {turns} turns", file=sys.stderr, flush=True)
            for name, each in own.items():
                found["backends"][name]["rounds"][f"{kind}{pairs}"] = each
        for name, backend in backends.items():
            found["backends"][name] |= backend.ask("kill")
    return found


class _Backend:
    """A backend in its own process and session."""

    def __init__(self, name: str) -> None:
        self._name = name
        path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, __file__, "--only", name, "--begun", str(time.time())]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
            env={**os.environ, "PYTHONPATH": path, "TOKENIZERS_PARALLELISM": "false"},
        )  # fmt: skip

    def ask(self, words: str) -> dict[str, Any]:
        """Let it do something; what it says of that."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        with suppress(BrokenPipeError):
            stdin.write(words + "\n")
            stdin.flush()
        for line in stdout:
            if line.startswith("{"):  # others are a tool's own
                return dict(json.loads(line))
        if words != "kill":  # which may end it with its workers
            raise FarmError(f"{self._name} ended; see its messages above")
        return {}

    def __enter__(self) -> "_Backend":
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


# ---------------------------------------------------------------- in a backend's process


def _serve(name: str, begun: float) -> None:
    with BACKENDS[name][2]() as (generation, kill):
        kind, pairs = "gait", 15
        for line in sys.stdin:
            match line.split():
                case ["start"]:
                    generation("gait" if name in PHYSICS else "zero", 15)
                    first = time.time() - begun
                    generation("gait", 15)
                    _say(first=first, memory=family()[1])
                case ["open", kind, number]:
                    pairs = int(number)
                    for _ in range(3):
                        generation(kind, pairs)
                    _say()
                case ["turn"]:
                    _say(**_turn(partial(generation, kind, pairs), more=name in RUNS, pairs=pairs))
                case ["kill"]:
                    _killed(kill)


def _turn(call: Callable[[], object], *, more: bool, pairs: int) -> dict[str, float]:
    """Wall time of a generation, its processor time, and the part of that which this process took [s]."""
    count, cores, own, begun = 0, family()[0], time.process_time(), time.perf_counter()
    while time.perf_counter() - begun < SECONDS:
        call()
        count += 1
    wall, cores, own = time.perf_counter() - begun, family()[0] - cores, time.process_time() - own
    each = 2 * pairs / (2 * pairs + more) / count  # a run's generation has one rollout more
    return {name: round(each * value, 7) for name, value in (("wall", wall), ("cores", cores), ("own", own))}


def _say(**values: object) -> None:
    print(json.dumps(values), flush=True)


def family(pid: int | None = None) -> tuple[float, float]:
    """Processor time [s] and proportional set size [MB] of a process and all its descendants; by default this one."""
    parents, spent = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                words = (entry / "stat").read_text().rpartition(")")[2].split()
                parents[int(entry.name)], spent[int(entry.name)] = int(words[1]), int(words[11]) + int(words[12])
    family, size = {pid or os.getpid()}, 0
    while len(family) > size:
        size = len(family)
        family |= {child for child, parent in parents.items() if parent in family}
    memory = 0
    for each in family:
        with suppress(OSError):
            lines = Path(f"/proc/{each}/smaps_rollup").read_text().splitlines()
            memory += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return sum(spent[each] for each in family) / os.sysconf("SC_CLK_TCK"), memory / 1024


def _killed(kill: "Kill") -> None:
    """Kill a worker during an evaluation, and say what happens."""
    if kill is None:
        _say()
        return
    work, victim = kill
    work()  # a first call may start workers
    before = time.perf_counter()
    alone = work()
    undisturbed = time.perf_counter() - before
    signal.signal(signal.SIGALRM, _hangs)
    signal.setitimer(signal.ITIMER_REAL, GIVE_UP)
    killer = subprocess.Popen(["/bin/sh", "-c", f"sleep {0.4 * undisturbed}; kill -9 {victim()}"])
    before = time.perf_counter()
    try:
        found = work()
    except Exception as error:
        _say(killed=type(error).__name__)
        return
    seconds = time.perf_counter() - before
    killer.wait()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    same = "the same returns" if np.array_equal(found, alone) else "different returns"
    _say(killed=f"{same}, {seconds - undisturbed:+.1f} s")


def _hangs(*_: object) -> None:
    _say(killed=f"it hangs (given up after {GIVE_UP:.0f} s)")
    os.killpg(0, signal.SIGKILL)


# ---------------------------------------------------------------- backends

Kill = tuple[Callable[[], FloatArray], Callable[[], int]] | None
Generation = Callable[[str, int], object]
Opened = Iterator[tuple[Generation, Kill]]
Evaluate = Callable[[str, FloatArray], FloatArray]
"""Returns of all rows of a kind."""


def _pooled(call: Evaluate, victim: Callable[[], int] | None) -> tuple[Generation, Kill]:
    """The function that runs a generation of a kind and number of pairs, and how to kill a worker during one."""
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
        yield lambda kind, pairs: pool.starmap(evaluations.physics, [(kind, pairs, 1)] * WORKERS, 1), None


@contextmanager
def of_loop() -> Opened:
    """The closed loop in this process without a farm, on two threads."""
    runners: dict[str, Runner] = {}

    def call(kind: str, rows: FloatArray) -> FloatArray:
        if kind == "zero":
            return evaluate(kind, rows)
        if kind not in runners:
            made = problem(evaluations.config(kind))
            runners[kind] = Runner(made.task, made.policy, lambda model: BatchEngine(model, 200, WORKERS))
        return runners[kind].rollouts(rows, [(row // 2,) for row in range(len(rows))]).returns

    yield _pooled(call, None)


@contextmanager
def of_multiprocessing() -> Opened:
    """The standard library's pool."""
    with multiprocessing.get_context("spawn").Pool(WORKERS) as pool:
        victim = pool.map(pid, range(2), 1)[0]

        def call(kind: str, rows: FloatArray) -> FloatArray:
            return np.concatenate(pool.starmap(evaluate, [(kind, half) for half in _halves(rows)], 1))

        yield _pooled(call, lambda: victim)


@contextmanager
def of_pipes(*, pinned: bool) -> Opened:
    """Two processes behind bare pipes, the least that a pool can be; pinned: each has its own core."""
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        ends = []
        for _ in range(WORKERS):
            end, other = context.Pipe()
            process = context.Process(target=evaluations.serve, args=(other,), daemon=True)
            process.start()
            if pinned:
                os.sched_setaffinity(process.pid or 0, {sorted(os.sched_getaffinity(0))[len(ends) % WORKERS]})
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
        return np.concatenate(ray.get([actor.evaluate.remote(kind, half) for actor, half in halves]))

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
            "max", lambda batch: torch.as_tensor(evaluate(kind, batch.numpy())), vectorized=True, num_actors=WORKERS,
            solution_length=evaluations.runner(kind).size, initial_bounds=(middle, middle), dtype=torch.float64,
        )  # fmt: skip
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

    with Client(n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, silence_logs="ERROR") as client:

        def call(kind: str, rows: FloatArray) -> FloatArray:
            return np.concatenate(client.gather(client.map(partial(evaluate, kind), _halves(rows), pure=False)))

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
            return pools[kind].map(rows, [row // 2 for row in range(len(rows))] if kind != "zero" else None)

        yield _pooled(call, lambda: pools["gait"].worker_pids[0])


@contextmanager
def of_run(*, record: bool) -> Opened:
    """`farm run`: it learns, and records if wanted."""
    runs: dict[tuple[str, int], Any] = {}
    with tempfile.TemporaryDirectory() as folder:

        def begun(kind: str, pairs: int) -> Any:  # noqa: ANN401
            config = evaluations.config(kind, generations=100_000)
            still = {"learning_rate_mu": 0.0, "learning_rate_sigma": 0.0, "initial_sigma": 0.02}
            middle = {"initial_mu": evaluations.STILL} if kind == "gait" else {}
            own = replace(config.algorithm_config, pairs=pairs, **still, **middle)
            place = Placement(workers=WORKERS, listen=free_endpoint(), record=record)
            path = Path(folder) / secrets.token_hex(4)
            with open_run(replace(config, algorithm_config=own), path, place) as run:
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


PHYSICS: Final = ("threads", "processes")
RUNS: Final = ("run", "recorded")
BACKENDS: Final[dict[str, tuple[str, str, Callable[[], Any]]]] = {
    "threads": ("physics alone, `mujoco.batch`, 2 threads", "mujoco", of_threads),
    "processes": ("physics alone, `mujoco.batch`, 2 processes", "mujoco", of_processes),
    "loop": ("closed loop, one process, 2 threads", "farm", of_loop),
    "pipes": ("two processes behind bare pipes", "multiprocessing", partial(of_pipes, pinned=False)),
    "pinned": ("the same, each on its own core", "multiprocessing", partial(of_pipes, pinned=True)),
    "multiprocessing": ("multiprocessing.Pool(2)", "multiprocessing", of_multiprocessing),
    "joblib": ("joblib with loky, 2 jobs", "joblib", of_joblib),
    "ray": ("Ray, 2 actors", "ray", of_ray),
    "evotorch": ("EvoTorch's PGPE on Ray, 2 actors", "evotorch", of_evotorch),
    "dask": ("Dask, 2 workers", "distributed", of_dask),
    "pool": ("`farm.Farm`, 2 workers", "farm", of_pool),
    "run": ("`farm run --no-record`, 2 workers, learning", "farm", partial(of_run, record=False)),
    "recorded": ("`farm run`, as typed: learning and recording", "rerun", partial(of_run, record=True)),
}


if __name__ == "__main__":
    from running import script

    script(main)
