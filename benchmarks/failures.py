"""What an algorithm is told of failed rollouts: four rules compared on a task in which some
rollouts fail.

    python benchmarks/failures.py [--seeds 5] [--generations 60]

A mass follows a target in a plane. A share of the rollouts fails, by a hash of an early action: as
if by chance (`by chance`), or if an action is large (`by action`: the physics of a stiff robot).
The rules, for the returns of a generation:

    floor       -1e12, as the rollout was reported
    worst       the worst return of a rollout that did not fail
    spread      that less a standard deviation of the returns of rollouts that did not fail
    left out    both rollouts of the pair count as equal

The score is the mean return over the starts, of 100 that no search has seen, from which the mean
policy did not fail; beside it, how many failed.
"""

import argparse
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from running import script

import farm
from farm import Task, TaskConfig, setting
from farm.arrays import BoolArray, FloatArray
from farm.net.work import NOT_NORMALISED
from farm.tasks.rollouts import RETURN_FLOOR
from learner.run.evaluation import evaluation_jobs
from learner.run.learner import explored
from learner.run.setup import problem

STARTS: Final = 100
SEED: Final = 1  # of the starts of the score
_TRIED: Final = 10  # the control step in which a rollout may fail


class Follow(Task):
    """Follow a target in a plane."""

    @dataclass(frozen=True, kw_only=True)
    class Config(TaskConfig):
        """Which rollouts fail."""

        share: float = setting(0.0, least=0.0, most=1.0)
        """Share of the rollouts that fail, by chance."""
        most: float = setting(1e9, above=0.0)
        """Largest action; with a larger one the rollout fails."""

    xml = """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody><body>
      <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <joint name="y" type="slide" axis="0 1 0" damping="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-5 5"/>
      <motor joint="y" ctrlrange="-5 5"/></actuator></mujoco>"""
    steps, substeps = 50, 2

    def reset(self, sim: Any, row: int, rng: np.random.Generator | None) -> None:  # noqa: ANN401
        """Draw a target."""
        goal = (0.7, -0.4) if rng is None else rng.uniform(-1, 1, 2)
        sim.own.setdefault("goal", np.zeros((len(sim), 2)))[row] = goal

    def observe(self, sim: Any) -> FloatArray:  # noqa: ANN401
        """Position, velocity, target."""
        return np.concatenate([sim.qpos, 0.3 * sim.qvel, sim.own["goal"]], axis=1)

    def act(self, sim: Any, action: FloatArray) -> FloatArray:  # noqa: ANN401
        """Let some rollouts fail."""
        fails = (np.abs(action) > self.config.most).any(axis=1)
        if sim.t == _TRIED:
            fails |= np.abs(action[:, 0] * 1000.0) % 1.0 < self.config.share
        sim.qvel[fails, 0] = np.inf
        return super().act(sim, action)

    def reward(self, sim: Any, action: FloatArray) -> FloatArray:  # noqa: ANN401, ARG002
        """Squared distance to the target."""
        return -((sim.qpos - sim.own["goal"]) ** 2).sum(axis=1)


def _floor(returns: FloatArray, sound: BoolArray) -> FloatArray:  # noqa: ARG001
    return returns


def _worst(returns: FloatArray, sound: BoolArray) -> FloatArray:
    return np.where(sound, returns, returns[sound].min())


def _spread(returns: FloatArray, sound: BoolArray) -> FloatArray:
    return np.where(sound, returns, returns[sound].min() - returns[sound].std())


def _left_out(returns: FloatArray, sound: BoolArray) -> FloatArray:
    whole = np.all(sound, axis=1, keepdims=True)
    return np.where(whole, returns, returns[sound].mean())


RULES: Final[dict[str, Callable[[FloatArray, BoolArray], FloatArray]]] = {
    "floor": _floor,
    "worst": _worst,
    "spread": _spread,
    "left out": _left_out,
}


def learnt(rule: str, seed: int, generations: int, **settings: Any) -> tuple[float, int]:  # noqa: ANN401
    """Mean return of the final mean policy over the starts from which it did not fail, and how many
    it failed from.
    """
    config = farm.configure(f"{__file__}:Follow", seed=seed, policy="linear", **settings)
    search = problem(config)
    runner = search.runner()
    state = search.begin()
    algorithm = config.algorithm_config
    for _ in range(generations):
        eps, jobs = explored(config, state)
        returns = runner.run(state.mu, jobs, "none", NOT_NORMALISED).returns.reshape(len(eps), -1)
        sound = returns > RETURN_FLOOR
        if sound.any():
            state = algorithm.tell(state, eps, RULES[rule](returns, sound))
    final = runner.run(state.mu, evaluation_jobs(STARTS, SEED)).returns[:STARTS]
    sound = final > RETURN_FLOOR
    return float(final[sound].mean()) if sound.any() else float("nan"), int((~sound).sum())


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=5)
    words.add_argument("--generations", type=int, default=60)
    arguments = words.parse_args()
    algorithms: dict[str, dict[str, Any]] = {
        "ars": {"algorithm": "ars", "initial_sigma": 0.1, "learning_rate_mu": 0.05},
        "pgpe": {
            "algorithm": "pgpe",
            "shaping": "raw",
            "initial_mu": 0.0,
            "initial_sigma": 0.3,
            "sigma_rule": "capped",
            "learning_rate_sigma": 0.05,
        },
    }
    fails = {
        "none": {},
        "3 % by chance": {"share": 0.03},
        "30 % by chance": {"share": 0.3},
        "by action": {"most": 1.2},
    }
    print("| algorithm | failures | " + " | ".join(RULES) + " |")
    print("|---" * (2 + len(RULES)) + "|")
    for name, algorithm in algorithms.items():
        for kind, share in fails.items():
            cells = []
            given = algorithm | share
            for rule in RULES:
                scores = [
                    learnt(rule, seed, arguments.generations, **given)
                    for seed in range(arguments.seeds)
                ]
                values = [value for value, _ in scores]
                extremes = f"{min(values):.3g} to {max(values):.3g}"
                failed = statistics.mean(count for _, count in scores)
                cells.append(f"{statistics.median(values):.3g} ({extremes}), {failed:.0f} failed")
            print(f"| {name} | {kind} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    script(main)
