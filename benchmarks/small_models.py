"""Processor time of a few rollouts of small models by part, and of the elementary functions; two
tables.

    python benchmarks/small_models.py [--rollouts 15 --rollouts 60] [--turns 15] [FILE.py:CLASS ...]

The rollouts run in this process on one thread, as in a worker, with the defaults that `farm run`
has for the task. Parts: MuJoCo's steps; the task's own methods (observe, act, reward, ended,
measure); the policy; and the rest, which is the farm's loop. A table has medians of the turns. The
functions get 30 numbers, which differ in each call.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from farm import elementary
from farm.runner import Runner
from learner.run.config import configure
from learner.run.setup import problem

TASKS = Path(__file__).parents[1] / "examples" / "tasks"
OWN = tuple(f"{TASKS / name}.py:{name.title()}" for name in ("pendulum", "cart", "arm", "hopper"))
PARTS = {
    "task": ("observe", "act", "reward", "ended", "measure"),
    "policy": ("act",),
    "engine": ("step",),
}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=OWN)
    parser.add_argument("--rollouts", type=int, action="append")
    parser.add_argument("--turns", type=int, default=15)
    arguments = parser.parse_args()
    print(
        "| task and policy | rollouts | all [ms] | physics [ms] | task [ms] | policy [ms] | loop"
        " [ms] | all / physics |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for task in arguments.tasks:
        config = configure(task)
        for count in arguments.rollouts or (15, 60):
            turns = _turns(problem(config).runner(), count, arguments.turns)
            total, physics, code, policy = (
                1e3 * statistics.median(column) for column in zip(*turns, strict=True)
            )
            ratio = statistics.median(turn[0] / turn[1] for turn in turns)
            cells = (
                f"{total:.1f} | {physics:.1f} | {code:.1f} | {policy:.1f} |"
                f" {total - physics - code - policy:.1f}"
            )
            print(
                f"| {Path(task).name}, {config.policy} | {count} | {cells} | {ratio:.2f} |",
                flush=True,
            )
    _functions()


def _turns(runner: Runner, count: int, turns: int) -> list[tuple[float, float, float, float]]:
    """Seconds of all, physics, task and policy in each turn."""
    theta = 0.05 * np.random.default_rng(0).standard_normal((count, runner.size))
    spent = dict.fromkeys(PARTS, 0.0)
    for part, owner in {
        "task": runner.task,
        "policy": runner.policy,
        "engine": runner.sim.engine,
    }.items():
        for name in PARTS[part]:
            setattr(owner, name, _timed(getattr(owner, name), spent, part))
    out = []
    for turn in range(turns + 1):
        spent.update(dict.fromkeys(spent, 0.0))
        start = time.process_time()
        runner.rollouts(theta, [(turn, row) for row in range(count)])
        out.append((time.process_time() - start, spent["engine"], spent["task"], spent["policy"]))
    return out[1:]  # the first one also makes what all need


def _timed(call: Callable[..., Any], spent: dict[str, float], part: str) -> Callable[..., Any]:
    def timed(*values: Any) -> Any:  # noqa: ANN401
        start = time.process_time()
        try:
            return call(*values)
        finally:
            spent[part] += time.process_time() - start

    return timed


def _functions() -> None:
    print("\n| function of 30 numbers | [us] | a sum of 30 numbers [us] |\n|---|---|---|")
    x, out = np.random.default_rng(0).standard_normal((20_000, 30)), np.empty(30)
    for function in (elementary.sin, elementary.cos, elementary.exp, elementary.tanh):
        times = [[], []]
        for part in np.array_split(x, 20):
            for each, call in zip(
                times, (function, lambda row: np.add(row, row, out)), strict=True
            ):
                start = time.process_time()
                for row in part:
                    call(row)
                each.append((time.process_time() - start) / len(part))
        evaluation, addition = (1e6 * statistics.median(each) for each in times)
        print(f"| {function.__name__} | {evaluation:.1f} | {addition:.2f} |")


if __name__ == "__main__":
    from running import script

    script(main)
