"""Rollouts and wall time until a given return, beside EvoTorch and sb3-contrib on the same two
cores; one table.

    python benchmarks/learning_speed.py [--seeds 5] [--tasks gait,Hopper,Arm] [--methods
        defaults,evotorch] [--out FILE.jsonl] [--table]

Needs evotorch and sb3-contrib: pip install evotorch sb3-contrib. Cells that are in the file are not
measured again, so an interrupted program continues.

    defaults    `farm run --task TASK --no-record` with two workers
    linear-ars  the same with --policy linear --algorithm ars --normalise
    evotorch    EvoTorch's PGPE with ClipUp and the settings of its own example, with the task's
                default policy
    ars         sb3-contrib's ARS with its defaults, a linear policy

Rollouts of the last two are made by two processes of a multiprocessing.Pool, half of a generation
each, which costs less than their own actors and environments. Both observe normalised numbers. A
method has reached the return when the mean policies of three generations in a row have it on 20
perturbed starts that no method learns from; they are tested afterwards, outside the time. The time
begins with the first candidates, when the others' processes are ready; that of `farm run` includes
the start of its workers. The returns were chosen on seed 10: four fifths of what the defaults gain
over a policy that does nothing.
"""

import argparse
import itertools
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, Final

import numpy as np
from own_tasks import TESTED, Rollouts, by_ars, by_evotorch
from running import keep, rows_of, script

import farm
from farm.arrays import FloatArray
from farm.moments import normaliser_of
from farm.net.work import Jobs
from farm.runner import Runner
from learner.run.evaluation import evaluation_jobs
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.tools.sweep.race import entry_of

HERE: Final = Path(__file__).parent
TABLE: Final = HERE.parent / "docs/results/tables/learning-speed.jsonl"
TASKS: Final = {
    "gait": ("finger-gait", 900, -1.2),
    "Hopper": (TESTED["Hopper"], 6000, 400.0),
    "Arm": (f"{HERE.parent / 'examples/tasks/arm.py'}:Arm", 6000, 35.0),
}
"""Task, rollouts at most, and the return to be reached."""
LINEAR: Final[dict[str, Any]] = {"policy": "linear", "algorithm": "ars", "normalise": True}
UNBIASED: Final[dict[str, Any]] = {"policy": "linear", "bias": False}
STARTS: Final = 20
IN_A_ROW: Final = 3

Mean = tuple[int, float, FloatArray, FloatArray]
"""Rollouts so far, seconds so far, mean (P,), and normaliser (2, d)."""
Search = Callable[[Pool, str, int, int], Iterator[Mean]]
"""Learns a task with a seed and so many rollouts at most.

It has learnt before it gives the first mean.
"""


class Shared(Rollouts):
    """Rollouts in two processes, half of a generation each; it notes the means."""

    def __init__(self, pool: Pool, task: str, seed: int, **policy: Any) -> None:  # noqa: ANN401
        super().__init__(task, seed, **policy)
        self._pool, self.means = pool, list[Mean]()
        self._config = {"task": task, "seed": seed, **(policy or {"policy": "linear"})}
        pool.starmap(ready, [(self._config,)] * 2, 1)
        self._begun = time.perf_counter()

    def simulated(self, jobs: Jobs) -> tuple[FloatArray, FloatArray]:
        """Returns and moments, as those of one process."""
        parts = [part.tolist() for part in np.array_split(np.arange(len(jobs)), 2) if len(part)]
        answers = self._pool.starmap(
            _half, [(self._config, jobs.take(part), self._normaliser()) for part in parts], 1
        )
        returns, moments = zip(*answers, strict=True)
        return np.concatenate(returns), np.concatenate(moments)

    def reached(self, mean: FloatArray) -> None:
        """Note it."""
        self.means.append(
            (self.done, time.perf_counter() - self._begun, mean, normaliser_of(self.moments))
        )


_runners: dict[str, Runner] = {}


def _runner(config: dict[str, Any]) -> Runner:
    """A process's own runner of a task and policy."""
    if str(config) not in _runners:
        _runners[str(config)] = problem(farm.configure(**config)).runner()
    return _runners[str(config)]


def ready(config: dict[str, Any]) -> None:
    """Make it."""
    _runner(config)
    time.sleep(0.2)  # so that the other process takes the other call


def _half(
    config: dict[str, Any], jobs: Jobs, normaliser: FloatArray
) -> tuple[FloatArray, FloatArray]:
    runner = _runner(config)
    results = runner.run(np.zeros(runner.size), jobs, normaliser=normaliser)
    return results.returns, results.moments


def reached(runner: Runner, means: Iterable[Mean], goal: float) -> tuple[int, float] | None:
    """Rollouts and seconds after which the means have the return; None if they never do."""
    good = list[tuple[int, float]]()
    for rollouts, seconds, mean, normaliser in means:
        results = runner.run(
            mean, evaluation_jobs(STARTS, 1), normaliser=np.stack([normaliser, normaliser])
        )
        good = [*good, (rollouts, seconds)] if results.returns[:STARTS].mean() >= goal else []
        if len(good) == IN_A_ROW:
            return good[0]
    return None


def of_peer(search: Callable[..., FloatArray], **policy: Any) -> Search:  # noqa: ANN401
    """Another library's search."""

    def learnt(pool: Pool, task: str, seed: int, rollouts: int) -> Iterator[Mean]:
        trial = Shared(pool, task, seed, **(policy or {"policy": farm.configure(task).policy}))
        search(trial, seed, rollouts)
        yield from trial.means

    return learnt


def of_farm(**settings: Any) -> Search:  # noqa: ANN401
    """`farm run`."""

    def learnt(_: Pool, task: str, seed: int, rollouts: int) -> Iterator[Mean]:
        config = farm.configure(task, seed=seed, **settings)
        config = replace(config, generations=entry_of("own", config).generations(rollouts))
        with tempfile.TemporaryDirectory() as folder:
            for _report in farm.learn(config, Path(folder) / "run", workers=2):
                pass
            stored = RunFolder.open(Path(folder) / "run")
            for line in stored.progress():
                yield line.rollouts, line.seconds, *stored.parameters.mean(line.generation)

    return learnt


METHODS: Final[dict[str, tuple[Search, dict[str, Any]]]] = {
    "defaults": (of_farm(), {}),
    "linear-ars": (of_farm(**LINEAR), LINEAR),
    "evotorch": (of_peer(by_evotorch), {}),
    "ars": (of_peer(by_ars, **UNBIASED), UNBIASED),
}
"""Each with the settings of its policy."""


def measured(pool: Pool, name: str, method: str, seed: int) -> tuple[int, float] | None:
    """Rollouts and seconds until a task's return; None if it is not reached."""
    task, rollouts, goal = TASKS[name]
    search, settings = METHODS[method]
    runner = problem(farm.configure(task, seed=seed, **settings)).runner()
    try:
        return reached(runner, search(pool, task, seed, rollouts), goal)
    finally:
        runner.close()


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Medians and ranges; how many seeds reached the return, if not all."""
    methods = [name for name in METHODS if any(row["method"] == name for row in rows)]
    yield f"| task, return | | {' | '.join(methods)} |"
    yield "|---" * (2 + len(methods)) + "|"
    for task in dict.fromkeys(row["task"] for row in rows):
        for what in ("rollouts", "seconds"):
            cells = [
                _cell([row[what] for row in rows if (row["task"], row["method"]) == (task, name)])
                for name in methods
            ]
            yield f"| {task}, {TASKS[task][2]:g} | {what} | {' | '.join(cells)} |"


def _cell(values: Sequence[float | None]) -> str:
    numbers = [value for value in values if value is not None]
    if not numbers:
        return f"none of {len(values)}" if values else "-"
    share = "" if len(numbers) == len(values) else f", {len(numbers)} of {len(values)} seeds"
    middle, low, high = (
        _number(value) for value in (statistics.median(numbers), min(numbers), max(numbers))
    )
    return f"{middle} ({low} to {high}){share}"


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def main() -> None:
    """Measure the cells that are missing, and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--tasks", type=lambda text: text.split(","), default=list(TASKS))
    words.add_argument("--methods", type=lambda text: text.split(","), default=list(METHODS))
    words.add_argument("--seeds", type=int, default=5, help="number of seeds, 0 and on")
    words.add_argument("--out", type=Path, default=TABLE)
    words.add_argument(
        "--table", action="store_true", help="print the file's table and measure nothing"
    )
    arguments = words.parse_args()
    rows = rows_of(arguments.out)
    if not arguments.table:
        done = {(row["task"], row["method"], row["seed"]) for row in rows}
        cells = itertools.product(range(arguments.seeds), arguments.tasks, arguments.methods)
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            for seed, task, method in cells:
                if (task, method, seed) not in done:
                    result = measured(pool, task, method, seed)
                    rollouts, seconds = (result[0], round(result[1], 2)) if result else (None, None)
                    rows.append(
                        {"task": task, "method": method, "seed": seed}
                        | {"rollouts": rollouts, "seconds": seconds}
                    )
                    keep(arguments.out, rows[-1])
    print("\n".join(table(sorted(rows, key=lambda row: list(TASKS).index(row["task"])))))


if __name__ == "__main__":
    script(main)
