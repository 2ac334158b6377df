"""A plate turned by regrasping, learnt with touch and without, beside holding still and the script; one table.

    python benchmarks/turning_learnt.py [--seeds 20,21] [--rows phase,phase+forces] [--video FILE] [--json FILE]

Each row is learnt by the farm in runs of its own under runs/turning, one per seed, with the preset of the task
`turning`; rows differ in what the policy sees. Policies are judged for 16 s from 200 perturbed starts that no run
trained on, and for 24 s with cycles of 3 s instead of 2. With shuffled touch every policy is given the forces that
another rollout's fingers feel. The film shows the last row's policy of the first seed from the nominal start.
"""

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

import farm
from benchmarks.turning import TURN, Keys, Script, Turned, film, script_of, task, turn
from farm import seeds
from farm.arrays import FloatArray
from farm.policies.base import Policy
from farm.sim import video
from farm.tasks import loop
from farm.tasks.finger_gait.hand import FINGERS
from farm.tasks.finger_gait.task import CONTROL_PERIOD, SUBSTEPS
from learner.replay import LoadedPolicy

ROWS: Final = "phase,phase+forces,phase+joints,phase+joints+forces"
LONG: Final[Mapping[str, Any]] = {"steps": 160}
"""How policies are judged."""
SLOW: Final[Mapping[str, Any]] = {"steps": 240, "cycle": 3.0}
"""And once more: as many cycles, each of them longer than in training."""
STARTS: Final[list[loop.Seed]] = [seeds.trial(9, i) for i in range(200)]
"""Starts that are judged."""

Figures = dict[str, float | None]
"""Of one policy from all starts, by column; None where there is none."""


class Shuffled:
    """A policy that is given the forces of another rollout."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def prepare(self, theta: FloatArray) -> FloatArray:
        """As the policy does."""
        return self._policy.prepare(theta)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d), whose last numbers are forces."""
        own = -len(FINGERS)
        return self._policy.act(prepared, np.concatenate([x[:, :own], np.roll(x[:, own:], 1, axis=0)], axis=1))


def main() -> None:
    """Learn, judge, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="20,21,22,23")
    parser.add_argument("--rows", default=ROWS, help="what policies see, with commas")
    parser.add_argument("--generations", type=int, help="other than the preset's")
    parser.add_argument("--video", type=Path, metavar="FILE", help=".gif or .mp4")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the table's numbers, seed by seed")
    chosen = parser.parse_args()
    if chosen.video is not None:
        video.check(chosen.video)
    options = {} if chosen.generations is None else {"generations": chosen.generations}
    names, numbers = chosen.rows.split(","), [int(word) for word in chosen.seeds.split(",")]
    table: dict[str, list[Figures]] = {}
    for name, found in _rows(names, numbers, options):
        if not table:
            print(f"| what the policy sees | {' | '.join(found[0])} |\n|---|{'---|' * len(found[0])}")
        table[name] = found
        cells = (", ".join(_cell(figures[column]) for figures in found) for column in found[0])
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if chosen.json is not None:
        chosen.json.write_text(json.dumps(table) + "\n")
    if chosen.video is not None:
        policy = farm.load(_learnt(names[-1], numbers[0], options), **LONG)
        shown = _turned(policy.runner.rollouts(policy.mu[None], [None], physics=True))
        lifts = (shown.felt[0, :-1] & ~shown.felt[0, 1:]).sum(axis=0).tolist()
        print(f"lifted in the film's 16 s: {dict(zip(FINGERS, lifts, strict=True))}")
        video.write(chosen.video, film(policy.runner.task, shown))


def _cell(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:g}"


def _learnt(name: str, number: int, options: Mapping[str, Any]) -> Path:
    """A run's folder; it is learnt if that has not been done."""
    config = farm.configure("turning", state=name, seed=number, **options)
    folder = Path("runs/turning", f"{name.replace('+', '-')}-g{config.generations}-s{number}")
    if not (folder / "summary.json").exists():
        for _ in farm.learn(config, folder, workers=1):
            pass
    return folder


def _rows(names: list[str], numbers: list[int], options: Mapping[str, Any]) -> Iterator[tuple[str, list[Figures]]]:
    """Rows of the table: their names, and what each seed's policy did."""
    gait = task()
    played = turn(gait, script_of(Keys(gait.hand, Script()), 15)[: LONG["steps"] * SUBSTEPS], STARTS)
    yield "the script", [_figures(Turned.of(played.qpos[:, ::SUBSTEPS], played.felt[:, ::SUBSTEPS]))]
    for name in names:
        folders = [_learnt(name, number, options) for number in numbers]
        policies = [farm.load(folder, **LONG) for folder in folders]
        if name == names[0]:
            yield "holding still", [_judged(policies[0], 0.0 * policies[0].mu)]
        yield name, [_judged(policy, policy.mu) for policy in policies]
        if "forces" in name:
            yield f"{name}, shuffled", [_judged(policy, policy.mu, shuffle=True) for policy in policies]
        policies = [farm.load(folder, **SLOW) for folder in folders]
        yield f"{name}, slowed", [_judged(policy, policy.mu) for policy in policies]


def _judged(policy: LoadedPolicy, mean: FloatArray, *, shuffle: bool = False) -> Figures:
    """What a mean (P,) does from the starts."""
    runner, theta = policy.runner, np.tile(mean, (len(STARTS), 1))
    acts = Shuffled(runner.policy) if shuffle else runner.policy
    return _figures(_turned(loop.run(runner.task, acts, runner.sim, theta, STARTS)))


def _turned(found: loop.Rollouts) -> Turned:
    """What the plate did in rollouts."""
    qpos, force = (
        np.concatenate([found.start[name][:, None], found.frames[name]], axis=1) for name in ("qpos", "force")
    )
    return Turned.of(qpos, (force > 0).any(axis=-1))


def _figures(found: Turned) -> Figures:
    """Of several rollouts, looked at once per control step; each counts until the plate is lost."""
    each = [found.first(row) for row in range(len(found.lost))]
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
        "lost [%]": round(100 * float(found.lost[:, -1].mean()), 1),
        "reached 360 [%]": round(100 * len(round_at) / len(each), 1),
        "after [s]": round(float(np.median(round_at)) * CONTROL_PERIOD, 1) if round_at else None,
    }


if __name__ == "__main__":
    main()
