"""Learns to turn a plate by regrasping, with touch and without; compares with the script and
holding still; one table.

    python benchmarks/turning_learnt.py [--seeds 20,21] [--rows phase,phase+forces] [--video FILE]
        [--json FILE]

Each row has one run per seed, under runs/turning, with the preset of the task `turning`; rows
differ in what the policy observes. Policies are tested for 16 s from 200 perturbed starts that were
not used for training, and for 24 s with cycles of 3 s instead of 2 (slowed). In rows with shuffled
forces each rollout gets the forces of a different rollout. The video shows the last row's policy
with the first seed, from the nominal start. Interrupted runs continue.
"""

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import learn
from turning import TURN, Keys, Script, Turned, film, script_of, task, turn

import farm
from farm import seeds
from farm.arrays import FloatArray
from farm.policies.base import Policy
from farm.sim import video
from farm.tasks import loop
from farm.tasks.finger_gait.hand import FINGERS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD, SUBSTEPS
from farm.tasks.rollouts import Rollouts, Seed
from learner.tools.replay.loaded import LoadedPolicy

ROWS: Final = "phase,phase+forces,phase+joints,phase+joints+forces"
LONG: Final[Mapping[str, Any]] = {"steps": 160}
"""Settings of the test."""
SLOW: Final[Mapping[str, Any]] = {"steps": 240, "cycle": 3.0}
"""Settings of the slowed test: the same number of cycles, each longer than in training."""
STARTS: Final[list[Seed]] = [seeds.evaluation_start(9, i) for i in range(200)]
"""Starts of the tests."""

Figures = dict[str, float | None]
"""Results of one policy from all starts, by column; None: there is no value."""


class Shuffled:
    """A policy that gets the forces of a different rollout."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Prepare as the policy does."""
        return self._policy.prepare(theta)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d), whose last numbers are forces."""
        split = -len(FINGERS)
        return self._policy.act(
            prepared, np.concatenate([x[:, :split], np.roll(x[:, split:], 1, axis=0)], axis=1)
        )


def main() -> None:
    """Learn, test, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="20,21,22,23")
    parser.add_argument(
        "--rows", default=ROWS, help="what the policies observe, separated by commas"
    )
    parser.add_argument(
        "--generations", type=int, help="number of generations instead of the preset's"
    )
    parser.add_argument("--video", type=Path, metavar="FILE", help="video file: .gif or .mp4")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="file for the table's numbers of each seed"
    )
    arguments = parser.parse_args()
    if arguments.video is not None:
        video.check(arguments.video)
    options = {} if arguments.generations is None else {"generations": arguments.generations}
    names, numbers = arguments.rows.split(","), [int(word) for word in arguments.seeds.split(",")]
    table: dict[str, list[Figures]] = {}
    for name, columns in _rows(names, numbers, options):
        if not table:
            print(
                f"| what the policy observes | {' | '.join(columns[0])} |\n"
                f"|---|{'---|' * len(columns[0])}"
            )
        table[name] = columns
        cells = (", ".join(_cell(figures[column]) for figures in columns) for column in columns[0])
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(table) + "\n")
    if arguments.video is not None:
        policy = farm.load(_learnt(names[-1], numbers[0], options), **LONG)
        result = _turned(policy.runner.rollouts(policy.mu[None], [None], physics=True))
        lifts = (result.felt[0, :-1] & ~result.felt[0, 1:]).sum(axis=0).tolist()
        print(f"fingers lifted in the 16 s of the video: {dict(zip(FINGERS, lifts, strict=True))}")
        video.write(arguments.video, film(policy.runner.task, result))


def _cell(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:g}"


def _learnt(name: str, number: int, options: Mapping[str, Any]) -> Path:
    """The folder of a run, which is learnt or continued unless it has finished."""
    config = farm.configure("turning", state=name, seed=number, **options)
    folder = Path("runs/turning", f"{name.replace('+', '-')}-g{config.generations}-s{number}")
    learn(config, folder, workers=1)
    return folder


def _rows(
    names: list[str], numbers: list[int], options: Mapping[str, Any]
) -> Iterator[tuple[str, list[Figures]]]:
    """Rows of the table: name, and the results of each seed's policy."""
    gait = task()
    played = turn(
        gait, script_of(Keys(gait.hand, Script()), 15)[: LONG["steps"] * SUBSTEPS], STARTS
    )
    yield (
        "the script",
        [_figures(Turned.of(played.qpos[:, ::SUBSTEPS], played.felt[:, ::SUBSTEPS]))],
    )
    for name in names:
        folders = [_learnt(name, number, options) for number in numbers]
        policies = [farm.load(folder, **LONG) for folder in folders]
        if name == names[0]:
            yield "holding still", [_tested(policies[0], 0.0 * policies[0].mu)]
        yield name, [_tested(policy, policy.mu) for policy in policies]
        if "forces" in name:
            yield (
                f"{name}, shuffled",
                [_tested(policy, policy.mu, shuffle=True) for policy in policies],
            )
        policies = [farm.load(folder, **SLOW) for folder in folders]
        yield f"{name}, slowed", [_tested(policy, policy.mu) for policy in policies]


def _tested(policy: LoadedPolicy, mean: FloatArray, *, shuffle: bool = False) -> Figures:
    """Results of a mean (P,) from the starts."""
    runner, theta = policy.runner, np.tile(mean, (len(STARTS), 1))
    acts = Shuffled(runner.policy) if shuffle else runner.policy
    rollouts, _ = loop.run(runner.task, acts, runner.sim, theta, STARTS, runner.spec)
    return _figures(_turned(rollouts))


def _turned(rollouts: Rollouts) -> Turned:
    """Motion of the plate in these rollouts."""
    qpos, force = (
        np.concatenate([rollouts.start[name][:, None], rollouts.frames[name]], axis=1)
        for name in ("qpos", "force")
    )
    return Turned.of(qpos, np.any(force > 0, axis=-1))


def _figures(result: Turned) -> Figures:
    """Results of several rollouts, from one value per control step.

    Each rollout counts until the plate is lost.
    """
    each = [result.first(row) for row in range(len(result.lost))]
    speed = [np.abs(np.diff(one.degrees[0])) / CONTROL_PERIOD for one in each]
    degrees = [one.degrees[0, -1] for one in each]
    round_at = [int(np.argmax(one.degrees[0] >= TURN)) for one in each if one.degrees.max() >= TURN]
    return {
        "turned [deg]": round(float(np.median(degrees))),
        "at least [deg]": round(min(degrees)),
        "median speed [deg/s]": round(float(np.median([np.median(one) for one in speed]))),
        "largest [deg/s]": round(max(one.max() for one in speed)),
        "tilt [deg]": round(max(one.tilt.max() for one in each), 1),
        "drift [mm]": round(1e3 * max(one.drift.max() for one in each), 1),
        "lost [%]": round(100 * float(result.lost[:, -1].mean()), 1),
        "reached 360 [%]": round(100 * len(round_at) / len(each), 1),
        "after [s]": round(float(np.median(round_at)) * CONTROL_PERIOD, 1) if round_at else None,
    }


if __name__ == "__main__":
    from running import script

    script(main)
