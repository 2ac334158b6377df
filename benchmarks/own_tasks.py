"""`farm tune` and the defaults for a task of one's own beside other libraries, with the same number of rollouts.

    python benchmarks/own_tasks.py [--tasks Hopper,Spin] [--methods tune,ars] [--seeds 5] [--rollouts 6000]
        [--processes 2] [--out docs/results/tables/own-tasks.jsonl] [--table]

Needs dm_control, evotorch, sb3-contrib and cma: pip install dm_control evotorch sb3-contrib cma. Each cell of the table
is one process; cells that are in the file are not computed again, so an interrupted program continues.

    still       the policy whose parameters are all 0: its action is the middle of the actuators' ranges
    constant    the best of 300 random constant actions, each tried on 10 starts: an opponent without feedback
    defaults    `farm run --task TASK`, with so many generations
    tune        `farm tune TASK` with this number of rollouts in all
    winner      `farm tune TASK` with twice as many: its winner has learnt from this number, and the search is extra
    evotorch    PGPE with ClipUp and the settings of EvoTorch's own example of a linear policy
    ars         sb3-contrib's ARS with its defaults
    pycma       CMA-ES with its default population

The last three search a linear policy with normalised observations, which is what the first two of them do in their own
examples; their rollouts are made here. The score is the mean return of the final mean policy from 100 perturbed starts
that no method has seen. The tasks are the test set: no setting of rolloutfarm was chosen on them, except for Hopper,
as docs/choosing.md says.
"""

import argparse
import math
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import keep, rows_of, script

import farm
from farm import seeds as streams
from farm.arrays import FloatArray
from farm.moments import merged, normaliser_of
from farm.net.work import Jobs
from farm.runner import Runner
from learner.run.evaluation import evaluation_jobs
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.tools.replay.loaded import loaded
from learner.tools.sweep.race import entry_of

HERE: Final = Path(__file__).parent
SUITE: Final = HERE / "suite.py"
TESTED: Final = {
    "Hopper": f"{HERE.parent / 'examples/tasks/hopper.py'}:Hopper",
    "Catch": f"{SUITE}:Catch",
    "Walker": f"{SUITE}:Walker",
    "Spin": f"{SUITE}:Spin",
    "Acrobot": f"{SUITE}:Acrobot",
    "Reach": f"{SUITE}:Reach",
}
HELD: Final = {name: f"{SUITE}:{name}" for name in ("Point", "Upright", "Fish", "Hop")}
"""On which no setting was chosen, and no rule of the pilot."""
TRAINED: Final = {"Swingup": f"{SUITE}:Swingup", "Cheetah": f"{SUITE}:Cheetah"}
STARTS: Final = 100
SEED: Final = 1  # of the starts of the score; `farm tune` and `farm run` use another for theirs


class Rollouts:
    """Rollouts of a linear policy with normalised observations, counted; each candidate has its own start."""

    def __init__(self, task: str, seed: int, **policy: Any) -> None:  # noqa: ANN401
        self.config = farm.configure(task, seed=seed, **(policy or {"policy": "linear"}))
        self.problem = problem(self.config)
        self.runner: Runner = self.problem.runner()
        self.size, self.done, self.rounds = self.runner.size, 0, 0
        self.moments = np.zeros(1 + 2 * self.problem.spec.observation)

    def _normaliser(self) -> FloatArray:
        return np.stack([normaliser_of(self.moments)] * 2)

    def __call__(self, thetas: FloatArray) -> FloatArray:
        """Returns (B,) of candidates (B, P)."""
        starts = [streams.training(self.config.seed, self.rounds, row) for row in range(len(thetas))]
        jobs = Jobs.exploring(np.ascontiguousarray(thetas, dtype=np.float64), (1,), starts)
        returns, moments = self.simulated(jobs)
        self.moments = merged(self.moments, moments)
        self.done, self.rounds = self.done + len(thetas), self.rounds + 1
        return returns

    def simulated(self, jobs: Jobs) -> tuple[FloatArray, FloatArray]:
        """Returns (S,) and moments of the observations (S, 1 + 2 d) of jobs around 0."""
        results = self.runner.run(np.zeros(self.size), jobs, normaliser=self._normaliser())
        return results.returns, results.moments

    def reached(self, mean: FloatArray) -> None:
        """A search's mean (P,) before each of its generations."""

    def score(self, theta: FloatArray) -> float:
        """The mean return of a candidate (P,) from the starts of the score."""
        jobs = evaluation_jobs(STARTS, SEED)
        return float(self.runner.run(theta, jobs, normaliser=self._normaliser()).returns[:STARTS].mean())


def still(task: str, seed: int, _: int) -> float:
    """Learns nothing."""
    trial = Rollouts(task, seed)
    return trial.score(np.zeros(trial.size))


def constant(task: str, seed: int, _: int, tries: int = 300, starts: int = 10) -> float:
    """The best of random constant actions, each tried on some starts."""
    trial = Rollouts(task, seed, policy="constant")
    thetas = np.random.default_rng(seed).uniform(-1.0, 1.0, (tries, trial.size))
    returns = sum(trial(thetas) for _ in range(starts))
    return trial.score(thetas[int(np.argmax(returns))])


def evotorch(task: str, seed: int, rollouts: int) -> float:
    """PGPE with ClipUp."""
    trial = Rollouts(task, seed)
    return trial.score(by_evotorch(trial, seed, rollouts))


def by_evotorch(trial: Rollouts, seed: int, rollouts: int) -> FloatArray:
    """The final mean; settings of the library's own linear policy for a walking robot, with a smaller population."""
    import torch
    from evotorch import Problem
    from evotorch.algorithms import PGPE

    torch.set_num_threads(1)
    learnt = Problem(
        "max", lambda batch: torch.as_tensor(trial(batch.numpy())), vectorized=True, seed=seed,
        solution_length=trial.size, initial_bounds=(0.0, 0.0), dtype=torch.float64,
    )  # fmt: skip
    search = PGPE(
        learnt, popsize=40, center_learning_rate=0.01125, stdev_learning_rate=0.1, radius_init=0.27,
        optimizer="clipup", optimizer_config={"max_speed": 0.015},
    )  # fmt: skip
    while trial.done < rollouts:
        search.step()
        trial.reached(search.status["center"].numpy().astype(np.float64))
    return search.status["center"].numpy().astype(np.float64)


def ars(task: str, seed: int, rollouts: int) -> float:
    """Augmented random search."""
    trial = Rollouts(task, seed, policy="linear", bias=False)
    return trial.score(by_ars(trial, seed, rollouts))


def by_ars(trial: Rollouts, seed: int, rollouts: int) -> FloatArray:
    """The final mean as sb3-contrib learns it: its own update, with the rollouts made here."""
    import gymnasium
    import torch
    from sb3_contrib import ARS

    torch.set_num_threads(1)
    shape = trial.problem.spec.observation, trial.problem.spec.action

    class Made(ARS):
        def evaluate_candidates(self, candidate_weights: Any, *_: object) -> Any:  # noqa: ANN401
            trial.reached(self.weights.numpy().astype(np.float64))
            returned = torch.as_tensor(trial(candidate_weights.numpy().astype(np.float64)), dtype=torch.float32)
            self.num_timesteps += len(candidate_weights)
            return returned

    class Spaces(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (shape[0],))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (shape[1],))

        def reset(self, **_: object) -> tuple[FloatArray, dict[str, Any]]:  # it only begins; no step follows
            return np.zeros(shape[0]), {}

    model = Made("LinearPolicy", Spaces(), seed=seed, device="cpu")
    model.learn(rollouts)
    return model.weights.numpy().astype(np.float64)


def pycma(task: str, seed: int, rollouts: int) -> float:
    """CMA-ES; the distribution's mean is scored."""
    import cma

    trial = Rollouts(task, seed)
    search = cma.CMAEvolutionStrategy([0.0] * trial.size, 0.3, {"seed": seed + 1, "verbose": -9})
    while trial.done < rollouts:
        thetas = search.ask()
        search.tell(thetas, -trial(np.array(thetas)))
    return trial.score(np.asarray(search.mean, dtype=np.float64))


def defaults(task: str, seed: int, rollouts: int) -> float:
    """What `farm run` learns."""
    alone = entry_of("default", farm.RunConfig(task=task, seed=seed))
    with tempfile.TemporaryDirectory() as folder:
        config = replace(alone.config, generations=alone.generations(rollouts))
        for _ in farm.learn(config, Path(folder) / "run", workers=1, record=False):
            pass
        return _score(Path(folder) / "run")


def tune(task: str, seed: int, rollouts: int) -> float:
    """A race."""
    return _raced(task, seed, rollouts)


def winner(task: str, seed: int, rollouts: int) -> float:
    """A race in which the winner has as many rollouts as the others have in all."""
    return _raced(task, seed, 2 * rollouts)


def _raced(task: str, seed: int, rollouts: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        done = farm.tune(farm.RunConfig(task=task, seed=seed), Path(folder) / "race", rollouts=rollouts, workers=1)
        print(f"{Path(task).name} seed {seed}: {done.winner.name}", file=sys.stderr)
        return _score(done.folder(done.winner))


def _score(run: Path) -> float:
    policy = loaded(RunFolder.open(run))
    return float(policy.runner.run(policy.mu, evaluation_jobs(STARTS, SEED)).returns[:STARTS].mean())


METHODS: Final[dict[str, Callable[[str, int, int], float]]] = {
    method.__name__: method for method in (still, constant, defaults, tune, winner, evotorch, ars, pycma)
}


def table(rows: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Markdown: the median over the seeds and the range, by task and method."""
    rows = list(rows)
    methods = [name for name in METHODS if any(row["method"] == name for row in rows)]
    yield "| task | " + " | ".join(methods) + " |"
    yield "|---" * (1 + len(methods)) + "|"
    for task in dict.fromkeys(row["task"] for row in rows):
        cells = []
        for method in methods:
            scores = [row["score"] for row in rows if (row["task"], row["method"]) == (task, method)] or [math.nan]
            low, middle, high = (f"{value:.3g}" for value in (min(scores), statistics.median(scores), max(scores)))
            cells.append(middle if low == high else f"{middle} ({low} to {high})")
        yield f"| {task} | " + " | ".join(cells) + " |"


def main() -> None:
    """Compute the cells that are missing, and print the table."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--tasks", default=",".join(TESTED))
    words.add_argument("--methods", default=",".join(METHODS))
    words.add_argument("--seeds", type=int, default=5)
    words.add_argument("--rollouts", type=int, default=6000)
    words.add_argument("--processes", type=int, default=2)
    words.add_argument("--out", type=Path, default=Path("own-tasks.jsonl"))
    words.add_argument("--table", action="store_true", help="print the file's table and compute nothing")
    arguments = words.parse_args()
    rows = rows_of(arguments.out)
    if not arguments.table:
        present = {(row["task"], row["method"], row["seed"], row["rollouts"]) for row in rows}
        cells = [
            (task, method, seed, arguments.rollouts)
            for seed in range(arguments.seeds)
            for task in arguments.tasks.split(",")
            for method in arguments.methods.split(",")
        ]
        with ProcessPoolExecutor(arguments.processes) as pool:
            tasks = TESTED | TRAINED | HELD
            waiting = {
                pool.submit(METHODS[method], tasks.get(task, task), seed, rollouts): (task, method, seed, rollouts)
                for task, method, seed, rollouts in cells
                if (task, method, seed, rollouts) not in present
            }
            for done in as_completed(waiting):
                row = dict(zip(("task", "method", "seed", "rollouts"), waiting[done], strict=True))
                rows.append(row | {"score": round(done.result(), 4)})
                keep(arguments.out, rows[-1])
    print(
        "\n".join(table(row for row in rows if row["rollouts"] == arguments.rollouts and row["seed"] < arguments.seeds))
    )


if __name__ == "__main__":
    script(main)
