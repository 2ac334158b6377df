"""Rollouts and wall time until a given return, beside EvoTorch and sb3-contrib on the same two cores; one table.

    python benchmarks/learning_speed.py [--seeds 0,1,2,3,4] [--tasks gait,Hopper,Arm] [--methods defaults,evotorch]

Needs evotorch and sb3-contrib: pip install evotorch sb3-contrib.

    defaults    `farm run --task TASK --no-record` with two workers
    linear-ars  the same with --policy linear --algorithm ars --normalise
    evotorch    EvoTorch's PGPE with ClipUp and the settings of its own example, with the task's default policy
    ars         sb3-contrib's ARS with its defaults, a linear policy

Rollouts of the last two are made by two processes of a multiprocessing.Pool, half of a generation each, which costs
less than their own actors and environments. Both observe normalised numbers. A method has reached the return when the
mean policies of three generations in a row have it on 20 perturbed starts that no method learns from; they are tested
afterwards, outside the time. The time begins with the first candidates, when the others' processes are ready; that of
`farm run` includes the start of its workers. The returns were chosen on seed 10: four fifths of what the defaults gain
over a policy that does nothing.
"""

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, Final

import numpy as np
from own_tasks import TESTED, Rollouts, by_ars, by_evotorch

import farm
from farm.arrays import FloatArray
from farm.moments import normaliser
from farm.net.work import Jobs
from farm.rollouts import Runner
from learner.again.replay import loaded
from learner.run.evaluation import evaluation_jobs
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.sweep.race import entry_of

HERE: Final = Path(__file__).parent
TASKS: Final = {
    "gait": ("finger-gait", 900, -1.2),
    "Hopper": (TESTED["Hopper"], 6000, 400.0),
    "Arm": (f"{HERE.parent / 'examples/tasks/arm.py'}:Arm", 6000, 35.0),
}
"""Task, rollouts at most, and the return to be reached."""
STARTS: Final = 20
IN_A_ROW: Final = 3

Means = list[tuple[int, float, FloatArray, FloatArray]]
"""Rollouts so far, seconds so far, mean (P,), and normaliser (2, d)."""


class Shared(Rollouts):
    """Rollouts in two processes, half of a generation each; it notes the means."""

    def __init__(self, pool: Pool, task: str, seed: int, **policy: Any) -> None:  # noqa: ANN401
        super().__init__(task, seed, **policy)
        self._pool, self.means = pool, Means()
        self._config = {"task": task, "seed": seed, **(policy or {"policy": "linear"})}
        pool.starmap(ready, [(self._config,)] * 2, 1)
        self._begun = time.perf_counter()

    def simulated(self, jobs: Jobs) -> tuple[FloatArray, FloatArray]:
        """Returns and moments, as those of one process."""
        parts = [part.tolist() for part in np.array_split(np.arange(len(jobs)), 2) if len(part)]
        given = self._pool.starmap(_half, [(self._config, jobs.take(part), self._normaliser()) for part in parts], 1)
        returns, moments = zip(*given, strict=True)
        return np.concatenate(returns), np.concatenate(moments)

    def reached(self, mean: FloatArray) -> None:
        """Note it."""
        self.means.append((self.done, time.perf_counter() - self._begun, mean, normaliser(self.moments)))


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


def _half(config: dict[str, Any], jobs: Jobs, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    runner = _runner(config)
    given = runner.run(np.zeros(runner.size), jobs, normaliser=seen)
    return given.returns, given.moments


def _scored(runner: Runner, means: Means, wanted: float) -> tuple[int, float] | None:
    """Rollouts and seconds after which the means have the return; None if they never do."""
    good = 0
    for at, (_, _, mean, seen) in enumerate(means):
        given = runner.run(mean, evaluation_jobs(STARTS, 1), normaliser=np.stack([seen, seen]))
        good = good + 1 if given.returns[:STARTS].mean() >= wanted else 0
        if good == IN_A_ROW:
            return means[at - IN_A_ROW + 1][:2]
    return None


def of_peer(search: Callable[..., FloatArray], **policy: Any) -> Callable[..., tuple[Runner, Means]]:  # noqa: ANN401
    """Another library's search."""

    def learnt(pool: Pool, task: str, seed: int, rollouts: int) -> tuple[Runner, Means]:
        own = policy or {"policy": farm.configure(task).policy}
        trial = Shared(pool, task, seed, **own)
        search(trial, seed, rollouts)
        return trial.runner, trial.means

    return learnt


def of_farm(**settings: Any) -> Callable[..., tuple[Runner, Means]]:  # noqa: ANN401
    """`farm run`."""

    def learnt(_: Pool, task: str, seed: int, rollouts: int) -> tuple[Runner, Means]:
        config = farm.configure(task, seed=seed, **settings)
        config = replace(config, generations=entry_of("own", config).generations(rollouts))
        with tempfile.TemporaryDirectory() as folder:
            path, means = Path(folder) / "run", Means()
            for _report in farm.learn(config, path, workers=2):
                pass
            stored = RunFolder.open(path)
            runner = problem(config).runner()
            for line in stored.progress():
                policy = loaded(stored, line.generation)
                seen = getattr(policy.problem.policy, "constants", {})
                names = [name for name in ("observation_mean", "observation_deviation") if name in seen]
                own = np.stack([seen[name] for name in names]) if names else np.empty((2, 0))
                means.append((line.rollouts, line.seconds, policy.mu, own))
        return runner, means

    return learnt


METHODS: Final[dict[str, Callable[..., tuple[Runner, Means]]]] = {
    "defaults": of_farm(),
    "linear-ars": of_farm(policy="linear", algorithm="ars", normalise=True),
    "evotorch": of_peer(by_evotorch),
    "ars": of_peer(by_ars, policy="linear", bias=False),
}


def main() -> None:
    """Learn, and print the table: medians and ranges; how many seeds reached the return, if not all."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--tasks", type=lambda text: text.split(","), default=list(TASKS))
    words.add_argument("--methods", type=lambda text: text.split(","), default=list(METHODS))
    words.add_argument("--seeds", type=lambda text: list(map(int, text.split(","))), default=list(range(5)))
    given = words.parse_args()
    print(f"| task, return | | {' | '.join(given.methods)} |")
    print(f"|---|---|{'---|' * len(given.methods)}")
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        for name in given.tasks:
            task, rollouts, wanted = TASKS[name]
            found = [[_scored(*METHODS[method](pool, task, seed, rollouts), wanted) for seed in given.seeds]
                     for method in given.methods]  # fmt: skip
            for row, what in enumerate(("rollouts", "seconds")):
                cells = [_cell([each[row] for each in cell if each], len(given.seeds)) for cell in found]
                print(f"| {name}, {wanted:g} | {what} | {' | '.join(cells)} |", flush=True)


def _cell(values: Sequence[float], seeds: int) -> str:
    if not values:
        return "never"
    low, high = min(values), max(values)
    some = "" if len(values) == seeds else f", {len(values)} of {seeds} seeds"
    return f"{statistics.median(values):.3g} ({low:.3g} to {high:.3g}){some}"


if __name__ == "__main__":
    from running import script

    script(main)
