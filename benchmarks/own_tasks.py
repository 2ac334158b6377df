"""`farm tune` and the defaults for a task of one's own beside other libraries, rollout for rollout.

    python benchmarks/own_tasks.py [--tasks Hopper,Spin] [--methods tune,ars] [--seeds 5]
        [--rollouts 6000] [--processes 2] [--out docs/results/tables/own-tasks.jsonl] [--table]

Needs other libraries: pip install dm_control gymnasium evotorch sb3-contrib stable-baselines3 cma.
Each cell of the table is one process; cells that are in the file are not computed again, so an
interrupted program continues. A cell that fails is named, and the others go on.

    still       the policy whose parameters are all 0: its action is the middle of the actuators'
                ranges
    constant    the best of 300 random constant actions, each tried on 10 starts: an opponent
                without feedback
    defaults    `farm run --task TASK`, with so many generations
    tune        `farm tune TASK` with this number of rollouts in all
    winner      `farm tune TASK` with twice as many: its winner has learnt from this number, and
                the search is extra
    evotorch    PGPE with ClipUp and the settings of EvoTorch's own example of a linear policy
    ars         sb3-contrib's ARS with its defaults
    pycma       CMA-ES with its default population
    ppo         stable-baselines3's PPO with its default network, for as many control steps as
                these rollouts have if none ends early

`evotorch`, `ars` and `pycma` search a linear policy with normalised observations, which is what the
first two of them do in their own examples; their rollouts are made here. The score is the mean
return of the run's policy from 100 perturbed starts that no method has seen. On eight tasks
(`--tasks Upright,Fish,Hop,Swim,Push,Stand,Stride,Turn`) nothing of rolloutfarm was chosen; on the
others, which it tries by default, some of its rules were.
"""

import argparse
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
from farm.arrays import BoolArray, FloatArray, IntArray
from farm.errors import RunError
from farm.moments import merged, normaliser_of
from farm.net.work import NOT_NORMALISED, Jobs
from farm.policies.base import Policy
from farm.runner import Runner
from farm.tasks.episodes import Episodes
from learner.run.evaluation import evaluation_jobs
from learner.run.folder import RunFolder
from learner.run.setup import Problem, problem
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
    "Point": f"{SUITE}:Point",
    "Balance": f"{SUITE}:Balance",
    "Ant": f"{SUITE}:Ant",
}
"""On which rules of the pilot or of the search were chosen."""
HELD: Final = {
    name: f"{SUITE}:{name}"
    for name in ("Upright", "Fish", "Hop", "Swim", "Push", "Stand", "Stride", "Turn")
}
"""On which nothing was chosen: no setting, no rule of the pilot, no rule of the search."""
TRAINED: Final = {"Swingup": f"{SUITE}:Swingup", "Cheetah": f"{SUITE}:Cheetah"}
STARTS: Final = 100
SEED: Final = 1  # of the starts of the score; `farm tune` and `farm run` use another for theirs


class Rollouts:
    """Rollouts of a linear policy with normalised observations, counted.

    Each candidate has its own start.
    """

    def __init__(self, task: str, seed: int, **policy: Any) -> None:  # noqa: ANN401
        self.config = farm.configure(task, seed=seed, **(policy or {"policy": "linear"}))
        self.problem = problem(self.config)
        self.runner: Runner = self.problem.runner()
        self.size = self.runner.size
        self.done = 0
        self.rounds = 0
        self.moments = np.zeros(1 + 2 * self.problem.spec.observation)

    def _normaliser(self) -> FloatArray:
        return np.stack([normaliser_of(self.moments)] * 2)

    def __call__(self, thetas: FloatArray) -> FloatArray:
        """Returns (B,) of candidates (B, P)."""
        seed = self.config.seed
        starts = [streams.training(seed, self.rounds, row) for row in range(len(thetas))]
        jobs = Jobs.exploring(np.ascontiguousarray(thetas, dtype=np.float64), (1,), starts)
        returns, moments = self.simulated(jobs)
        self.moments = merged(self.moments, moments)
        self.done += len(thetas)
        self.rounds += 1
        return returns

    def simulated(self, jobs: Jobs) -> tuple[FloatArray, FloatArray]:
        """Returns (S,) and moments of the observations (S, 1 + 2 d) of jobs around 0."""
        results = self.runner.run(np.zeros(self.size), jobs, normaliser=self._normaliser())
        return results.returns, results.moments

    def reached(self, mean: FloatArray) -> None:
        """A search's mean (P,) before each of its generations."""

    def score(self, theta: FloatArray) -> float:
        """The mean return of a candidate (P,) from the starts of the score."""
        return _scored(self.runner, theta, self._normaliser())


def _scored(
    runner: Runner,
    theta: FloatArray,
    normaliser: FloatArray = NOT_NORMALISED,
) -> float:
    """The mean return of parameters (P,) from the starts of the score."""
    results = runner.run(theta, evaluation_jobs(STARTS, SEED), normaliser=normaliser)
    return float(results.returns[:STARTS].mean())


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
    """The final mean; settings of the library's own linear policy for a walking robot.

    Its population is smaller here.
    """
    import torch
    from evotorch import Problem
    from evotorch.algorithms import PGPE

    torch.set_num_threads(1)
    learnt = Problem(
        "max",
        lambda batch: torch.as_tensor(trial(batch.numpy())),
        vectorized=True,
        seed=seed,
        solution_length=trial.size,
        initial_bounds=(0.0, 0.0),
        dtype=torch.float64,
    )
    search = PGPE(
        learnt,
        popsize=40,
        center_learning_rate=0.01125,
        stdev_learning_rate=0.1,
        radius_init=0.27,
        optimizer="clipup",
        optimizer_config={"max_speed": 0.015},
    )
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
    spec = trial.problem.spec

    class Made(ARS):
        def evaluate_candidates(self, candidate_weights: Any, *_: object) -> Any:  # noqa: ANN401
            trial.reached(self.weights.numpy().astype(np.float64))
            returned = trial(candidate_weights.numpy().astype(np.float64))
            self.num_timesteps += len(candidate_weights)
            return torch.as_tensor(returned, dtype=torch.float32)

    class Spaces(gymnasium.Env[Any, Any]):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (spec.observation,))
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.action,))

        def reset(self, **_: object) -> tuple[FloatArray, dict[str, Any]]:
            return np.zeros(spec.observation), {}  # it only begins; no step follows

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


def ppo(task: str, seed: int, rollouts: int) -> float:
    """Proximal policy optimization, with as many control steps as the rollouts have at most.

    Network and hyperparameters are the library's defaults, and its VecNormalize normalises
    observations and rewards, as RL Zoo has it for MuJoCo's tasks. Two things differ, as in
    examples/ppo.py, to save time: the 2048 control steps of an update come from 8 environments,
    and a minibatch has 256 samples instead of 64. The deterministic policy is scored.
    """
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    made = problem(farm.configure(task, seed=seed))
    envs = VecNormalize(_environments(task, Together(made, seed)))
    model = PPO("MlpPolicy", envs, n_steps=256, batch_size=256, seed=seed, device="cpu")
    model.learn(rollouts * made.spec.steps)

    class Learnt(Policy):
        def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:  # noqa: ARG002
            action, _ = model.predict(envs.normalize_obs(x), deterministic=True)
            return np.asarray(action, dtype=np.float64)

    policy = Learnt(made.policy.config, made.spec, {})
    return _scored(Runner(made.task, policy), np.zeros(1))


class Together:
    """Rollouts of the farm that are stepped together; one that ends is followed by another."""

    def __init__(self, made: Problem, seed: int, count: int = 8) -> None:
        self.count = count
        self._seed = seed
        self._begun = 0
        spec = made.spec
        self._episodes = Episodes(made.task, count, spec.observation, len(spec.terms))

    def _begin(self, rows: IntArray) -> None:
        starts = [streams.training(self._seed, self._begun, row) for row in rows.tolist()]
        self._episodes.begin(rows, starts)
        self._begun += 1

    def reset(self) -> FloatArray:
        """First observations (B, d)."""
        self._episodes.stop()
        self._begin(np.arange(self.count))
        return self._episodes.last.observation.copy()

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray, list[Any]]:
        """Observations (B, d), rewards (B,), what ended, and of these the last observations."""
        self._episodes.step(actions)
        last = self._episodes.last
        rewards = last.terms.sum(axis=1)
        over = last.terminated | last.truncated
        infos = [
            {"terminal_observation": x.copy(), "TimeLimit.truncated": bool(cut)}
            for x, cut in zip(last.observation, last.truncated, strict=True)
        ]
        if over.any():
            self._begin(np.flatnonzero(over))
        return last.observation.copy(), rewards, over, infos


def _environments(task: str, together: Together) -> Any:  # noqa: ANN401
    """The same as stable-baselines3 takes them, with the spaces of `farm.environment`."""
    from stable_baselines3.common.vec_env import VecEnv

    one = farm.environment(task)

    class Environments(VecEnv):
        def reset(self) -> FloatArray:
            return together.reset()

        def step_async(self, actions: FloatArray) -> None:
            self.actions = actions.astype(np.float64)

        def step_wait(self) -> tuple[FloatArray, FloatArray, BoolArray, list[Any]]:
            return together.step(self.actions)

        def _nothing(self, *_: object, **__: object) -> list[None]:
            return [None] * together.count

        close = get_attr = set_attr = env_method = env_is_wrapped = _nothing

    return Environments(together.count, one.observation_space, one.action_space)


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
        config = farm.RunConfig(task=task, seed=seed)
        done = farm.tune(config, Path(folder) / "race", rollouts=rollouts, workers=1)
        print(f"{Path(task).name} seed {seed}: {done.winner.name}", file=sys.stderr)
        return _score(done.folder(done.winner))


def _score(run: Path) -> float:
    policy = loaded(RunFolder.open(run))
    return _scored(policy.runner, policy.mu)


Cell = tuple[str, str, int, int]
"""Its task, method, seed and rollouts."""

METHODS: Final[dict[str, Callable[[str, int, int], float]]] = {
    method.__name__: method
    for method in (still, constant, defaults, tune, winner, evotorch, ars, pycma, ppo)
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
            here = [row for row in rows if (row["task"], row["method"]) == (task, method)]
            cells.append(_cell([row["score"] for row in here]))
        yield f"| {task} | " + " | ".join(cells) + " |"


def _cell(scores: list[float]) -> str:
    """Median and range, or a dash."""
    if not scores:
        return "-"
    three = min(scores), statistics.median(scores), max(scores)
    low, middle, high = (f"{value:.3g}" for value in three)
    return middle if low == high else f"{middle} ({low} to {high})"


def main() -> None:
    """Compute the cells that are missing, and print the table."""
    raw = argparse.RawDescriptionHelpFormatter
    words = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    words.add_argument("--tasks", default=",".join(TESTED))
    words.add_argument("--methods", default=",".join(METHODS))
    words.add_argument("--seeds", type=int, default=5)
    words.add_argument("--rollouts", type=int, default=6000)
    words.add_argument("--processes", type=int, default=2)
    words.add_argument("--out", type=Path, default=Path("own-tasks.jsonl"))
    words.add_argument("--table", action="store_true", help="print the file's table, no more")
    arguments = words.parse_args()
    rollouts = arguments.rollouts
    rows = rows_of(arguments.out)
    failed = 0
    if not arguments.table:
        cells = [
            (task, method, seed, rollouts)
            for seed in range(arguments.seeds)
            for task in arguments.tasks.split(",")
            for method in arguments.methods.split(",")
        ]
        failed = _compute(cells, rows, arguments.out, arguments.processes)
    shown = [row for row in rows if row["rollouts"] == rollouts and row["seed"] < arguments.seeds]
    print("\n".join(table(shown)))
    if failed:
        raise RunError(f"{failed} cells failed; see their messages above")


def _compute(
    cells: Iterable[Cell],
    rows: list[dict[str, Any]],
    out: Path,
    processes: int,
) -> int:
    """Compute the cells that are not among the rows, each in a process; how many failed."""
    names = ("task", "method", "seed", "rollouts")
    present = {tuple(row[name] for name in names) for row in rows}
    tasks = TESTED | TRAINED | HELD
    failed = 0
    with ProcessPoolExecutor(processes) as pool:
        waiting = {
            pool.submit(METHODS[cell[1]], tasks.get(cell[0], cell[0]), *cell[2:]): cell
            for cell in cells
            if cell not in present
        }
        for done in as_completed(waiting):
            cell = waiting[done]
            error = done.exception()
            if error is None:
                row = dict(zip(names, cell, strict=True))
                rows.append(row | {"score": round(done.result(), 4)})
                keep(out, rows[-1])
            else:
                failed += 1
                print(f"{cell[0]}, {cell[1]}, seed {cell[2]}: {error!r}", file=sys.stderr)
    return failed


if __name__ == "__main__":
    script(main)
