"""Compares the farm with a process pool, joblib, Ray, EvoTorch on Ray, and Dask: two tables, and
their numbers.

    python benchmarks/peers.py [--turns 10] [--names pool,run] [--out
        docs/results/tables/peers.json] [--table]

Each backend is a process that stays; they work in turns of about a second, one after another,
because the speed of a shared machine changes within seconds. All evaluate the same: generations of
15 and of 100 mirrored pairs of the finger gait, held still so that no rollout ends early, and of
the arm of examples/; and generations of empty evaluations. The speed of a turn is that relative to
the same physics steps alone in the same round of turns, by the faster of two threads of
`mujoco.batch` and two processes; processor time is that of a backend's processes together, of which
one is no worker. The other tools get each worker's half of a generation in one call, which is
fastest for them, and do not update or save anything. `farm run` updates, saves and, as users type
it, records; it also simulates its mean policy, which counts as a rollout.

Numbers of a machine that is not steady are shown, but not written. Tools that are not installed are
left out: `pip install ray distributed evotorch joblib` installs all.
"""

import argparse
import importlib.util
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from backends import BACKENDS, PHYSICS, RUNS, Kill

from farm.errors import FarmError

ROUNDS: Final = (
    ("gait", 15),
    ("gait", 100),
    ("arm", 15),
    ("arm", 100),
    ("zero", 15),
    ("zero", 100),
)
"""Kinds of evaluations, and pairs of a generation."""
SECONDS: Final = 1.0  # of a turn
GIVE_UP: Final = 10.0  # [s] after which an evaluation counts as hanging
STEADY: Final = 1.5
"""How much longer the slowest of bare physics' turns may take than the fastest, so that the machine
counts as steady.
"""


def main() -> None:
    """Measure what is asked for, and print the tables of the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--names", type=lambda text: text.split(","), default=list(BACKENDS))
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--table", type=Path, help="print the tables of such a file, and measure nothing"
    )
    parser.add_argument("--only", choices=BACKENDS, help=argparse.SUPPRESS)
    parser.add_argument("--begun", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.only:
        _serve(arguments.only, arguments.begun)
        return
    if not arguments.table:
        results = _measured(
            arguments.turns, [name for name in BACKENDS if name in {*PHYSICS, *arguments.names}]
        )
        if arguments.out and _spread_of_physics(results) <= STEADY:
            arguments.out.write_text(json.dumps(results, separators=(",", ":")) + "\n")
    else:
        results = json.loads(arguments.table.read_text())
    print("\n".join(table(results)))
    if (spread := _spread_of_physics(results)) > STEADY:
        raise FarmError(
            f"the machine is not steady: bare physics takes from 1 to {spread:.2f} times as long,"
            f" and at most {STEADY} is accepted; measure again when nothing else runs"
        )


def table(results: dict[str, Any]) -> Iterator[str]:
    """The lines of both tables: medians of the turns, lowest to highest in parentheses."""
    backends = results["backends"]
    kinds = [(f"{kind}{pairs}", f"{kind}, {2 * pairs}") for kind, pairs in ROUNDS if kind != "zero"]
    heads = [
        *(head for _, head in kinds),
        "core-ms at 30",
        "not its workers'",
        "30 empty [ms]",
        "200 [ms]",
        "first [s]",
        "MB",
        "a killed worker",
    ]
    base = _physics(backends)
    yield (
        f"{results['machine']}; {results['turns']} turns; bare physics takes from 1 to"
        f" {_spread_of_physics(results):.2f} times as long"
    )
    yield ""
    yield f"| | {' | '.join(heads)} |"
    yield "|---" * (len(heads) + 1) + "|"
    for name, row in backends.items():
        cells = [_spread(base, row, key, _faster) for key, _ in kinds]
        cells += [f"{_median(row, 'gait15', part):.1f}" for part in ("cores", "own")]
        cells += [
            f"{_median(row, key, 'wall'):.2f}" if key in row["rounds"] else "-"
            for key in ("zero15", "zero100")
        ]
        cells += [f"{row['first']:.1f}", f"{row['memory']:.0f}", row.get("killed", "-")]
        yield f"| {BACKENDS[name][0]} | {' | '.join(cells)} |"
    yield ""
    yield f"| ratio, turn by turn | {' | '.join(head for _, head in kinds)} |"
    yield "|---" * (len(kinds) + 1) + "|"
    for words, first, second, ratio in RATIOS:
        if first in backends and second in backends:
            cells = [_spread(backends[first], backends[second], key, ratio, 3) for key, _ in kinds]
            yield f"| {words} | {' | '.join(cells)} |"


def _physics(backends: dict[str, Any]) -> dict[str, Any]:
    """Bare physics, in each turn the faster of two threads and two processes."""
    rounds = [backends[name]["rounds"] for name in PHYSICS]
    return {
        "rounds": {
            key: [
                min(turns, key=lambda turn: turn["wall"])
                for turns in zip(*(each[key] for each in rounds), strict=True)
            ]
            for key in rounds[0]
        }
    }


def _spread_of_physics(results: dict[str, Any]) -> float:
    """Slowest turn of bare physics relative to its fastest, of the kind that differs most."""
    walls = [
        [turn["wall"] for turn in turns]
        for turns in _physics(results["backends"])["rounds"].values()
    ]
    return max(max(each) / min(each) for each in walls)


FIRST_PAGE: Final = ("multiprocessing", "ray", "dask", "pool", "recorded")
"""Backends of README's table."""
_RUN_GOES_ON: Final = "the same parameters, +1.0 s"  # docs/results/reliability.md, "Faults"


def first_page(results: dict[str, Any]) -> Iterator[str]:
    """The rows of README's table: what happens when a worker is killed, first result, memory."""
    for name in FIRST_PAGE:
        row = results["backends"][name]
        killed = row.get("killed", _RUN_GOES_ON)
        yield f"| {BACKENDS[name][0]} | {killed} | {row['first']:.1f} | {row['memory']:.0f} |"


def _median(backend: dict[str, Any], key: str, part: str) -> float:
    return 1e3 * statistics.median(turn[part] for turn in backend["rounds"][key])


def _spread(
    first: dict[str, Any], second: dict[str, Any], key: str, ratio: "Ratio", digits: int = 2
) -> str:
    turns = [ratio(*both) for both in zip(first["rounds"][key], second["rounds"][key], strict=True)]
    return (
        f"{statistics.median(turns):.{digits}f} ({min(turns):.{digits}f} to"
        f" {max(turns):.{digits}f})"
    )


Ratio = Callable[[dict[str, float], dict[str, float]], float]
"""Of a turn of one backend and the turn of another in the same round."""


def _faster(first: dict[str, float], second: dict[str, float]) -> float:
    return first["wall"] / second["wall"]


def _workers(turn: dict[str, float]) -> float:
    return turn["cores"] - turn["own"]


RATIOS: Final[tuple[tuple[str, str, str, Ratio], ...]] = (
    ("speed of `farm.Farm` to bare pipes", "pipes", "pool", _faster),
    ("speed of `farm run`, as typed, to Pool(2)", "multiprocessing", "recorded", _faster),
    (
        "learner's processor time to its workers', not recording",
        "run",
        "run",
        lambda _, b: b["own"] / _workers(b),
    ),
    ("the same, recording", "recorded", "recorded", lambda _, b: b["own"] / _workers(b)),
    (
        "workers' processor time, recording to not",
        "run",
        "recorded",
        lambda a, b: _workers(b) / _workers(a),
    ),
)


def _measured(turns: int, names: list[str]) -> dict[str, Any]:
    available = {
        name: BACKENDS[name] for name in names if importlib.util.find_spec(BACKENDS[name][1])
    }
    for name in names:
        if name not in available:
            print(
                f"{BACKENDS[name][0]} is left out: {BACKENDS[name][1]} is not installed",
                file=sys.stderr,
            )
    results: dict[str, Any] = {
        "machine": (
            f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}, "
            f"MuJoCo {mujoco.__version__}, {time.strftime('%Y-%m-%d')}"
        ),
        "turns": turns,
        "backends": {name: {"rounds": {}} for name in available},
    }
    with ExitStack() as stack:
        backends: dict[str, _Backend] = {}
        for name in available:  # one after another: the time of the first result counts
            backends[name] = stack.enter_context(_Backend(name))
            results["backends"][name] |= backends[name].ask("start")
        for kind, pairs in ROUNDS:
            able = {
                name: backend
                for name, backend in backends.items()
                if kind != "zero" or name not in PHYSICS
            }
            turns_of = {name: [] for name in able}
            for backend in able.values():
                backend.ask(f"open {kind} {pairs}")
            for turn in range(turns):
                for name, backend in able.items():
                    turns_of[name].append(backend.ask("turn"))
                print(
                    f"{kind}, {pairs} pairs: {turn + 1} of {turns} turns",
                    file=sys.stderr,
                    flush=True,
                )
            for name, each in turns_of.items():
                results["backends"][name]["rounds"][f"{kind}{pairs}"] = each
        for name, backend in backends.items():
            results["backends"][name] |= backend.ask("kill")
    return results


class _Backend:
    """A backend in its own process and session."""

    def __init__(self, name: str) -> None:
        self._name = name
        path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, __file__, "--only", name, "--begun", str(time.time())]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": path, "TOKENIZERS_PARALLELISM": "false"},
        )

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


def _serve(name: str, start: float) -> None:
    with BACKENDS[name][2]() as (generation, kill):
        kind, pairs = "gait", 15
        for line in sys.stdin:
            match line.split():
                case ["start"]:
                    generation("gait" if name in PHYSICS else "zero", 15)
                    first = time.time() - start
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
    """Wall time of a generation, its processor time, and the part of that which this process took
    [s].
    """
    count, cores, process, start = 0, family()[0], time.process_time(), time.perf_counter()
    while time.perf_counter() - start < SECONDS:
        call()
        count += 1
    wall = time.perf_counter() - start
    cores = family()[0] - cores
    process = time.process_time() - process
    each = 2 * pairs / (2 * pairs + more) / count  # a run's generation has one rollout more
    return {
        name: round(each * value, 7)
        for name, value in (("wall", wall), ("cores", cores), ("own", process))
    }


def _say(**values: object) -> None:
    print(json.dumps(values), flush=True)


def family(pid: int | None = None) -> tuple[float, float]:
    """Processor time [s] and proportional set size [MB] of a process and all its descendants.

    By default this one.
    """
    parents, spent = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                words = (entry / "stat").read_text().rpartition(")")[2].split()
                parents[int(entry.name)] = int(words[1])
                spent[int(entry.name)] = int(words[11]) + int(words[12])
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


def _killed(kill: Kill) -> None:
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
        returns = work()
    except Exception as error:
        _say(killed=type(error).__name__)
        return
    seconds = time.perf_counter() - before
    killer.wait()
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    same = "the same returns" if np.array_equal(returns, alone) else "different returns"
    _say(killed=f"{same}, {seconds - undisturbed:+.1f} s")


def _hangs(*_: object) -> None:
    _say(killed=f"it hangs (given up after {GIVE_UP:.0f} s)")
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    from running import script

    script(main)
