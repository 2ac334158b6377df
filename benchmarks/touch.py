"""Learns the fragile bar with and without touch; writes a table, a figure, and the numbers.

    python benchmarks/touch.py [--seeds 20,21,22,23,24] [--bias 0.05] [--out docs/results/touch]
        [--rows forces,joints]

Each row is learnt by the farm for 1280 rollouts, in runs under runs/touch, and tested on 200 starts
that were not used for training: the average of its last ten means, and its last mean alone.
Settings were chosen with seeds 0 to 14. The policies without touch are the best constant targets,
and functions of time, of the joints, of the joints and their targets (a servo's deflection measures
force), and of the joints with a memory. The last two rows are hand-made. One closes the middle
finger at a constant rate until its joints lag by a given angle; rate and lag are the best of a grid
on separate starts. The other measures the joints' errors while it holds still, and then estimates
the force from the servos' deflections; it succeeds on nearly every start without touch. Interrupted
runs continue.
"""

import argparse
import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import farm
from farm.arrays import AnyArray, FloatArray
from farm.policies.base import Policy
from farm.runner import Runner
from farm.settings import setting
from farm.sim.sim import Sim
from farm.tasks.base import TaskSpec
from farm.tasks.finger_gait.fragile_bar import BREAKS, TERMS, WANTED, FragileBar, FragileBarConfig
from farm.tasks.finger_gait.hand import FINGER_JOINTS, FINGERS, JOINTS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Seed
from learner.run.folder import RunFolder
from learner.run.setup import problem
from learner.tools.replay.loaded import loaded

HERE = Path(__file__).resolve()
STARTS: tuple[Seed, ...] = tuple((2, 0, 9, i) for i in range(200))
"""Starts of the test."""
GRID: tuple[Seed, ...] = tuple((2, 0, 8, i) for i in range(100))
"""Starts on which the expert's rate and lag are chosen."""
FITS: tuple[Seed, ...] = tuple((2, 0, 7, i) for i in range(256))
"""Starts on which the map from deflections to force is fitted."""
BLIND = {"time": 1, "joints+targets": 16, "joints+memory": 16}
"""Observations without touch that the task does not offer, and their sizes."""


@dataclass(frozen=True, kw_only=True)
class BlindConfig(FragileBarConfig):
    """The fragile bar's settings, with a different choice of observations."""

    sight: str = "time"
    """The policy's observation: time | joints+targets | joints+memory."""
    memory: float = setting(0.7, least=0.0, below=1.0)
    """Share of the memory that is kept at each control step."""


class Blind(FragileBar):
    """The fragile bar for policies without touch."""

    Config = BlindConfig

    def spec(self) -> TaskSpec:
        """The fragile bar's specification, with this observation."""
        return TaskSpec(
            observation=BLIND[self.config.sight],
            action=len(JOINTS),
            steps=self.steps,
            period=CONTROL_PERIOD,
            terms=TERMS,
            success=True,
            channels=self.channels,
        )

    @property
    def parts(self) -> tuple[int, ...]:
        """Sizes of the parts: one for each kind of number."""
        size = BLIND[self.config.sight]
        return (size,) if size == 1 else (len(JOINTS), len(JOINTS))

    def observe(self, sim: Sim) -> FloatArray:
        """Time, or the joint readings with their targets or their running mean."""
        if self.config.sight == "time":
            return np.full((len(sim), 1), sim.t / self.steps)
        q = sim.qpos[:, : len(JOINTS)] + sim.own["noise"][:, min(sim.t, self.steps - 1)]
        if self.config.sight == "joints+targets":
            return np.concatenate([q, sim.own["target"]], axis=1)
        keep = self.config.memory
        past = sim.own.get("past", q)
        sim.own["past"] = keep * past + (1.0 - keep) * q
        return np.concatenate([q, sim.own["past"]], axis=1)


class Constant(Policy):
    """The same action at every step: a = theta."""

    @property
    def size(self) -> int:
        """A."""
        return self.spec.action

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:  # noqa: ARG002
        """Actions."""
        return np.array(prepared)


WIDE: dict[str, Any] = {
    "width": 1.77,
    "weight_scale": 0.25,
    "initial_sigma": 1.0,
    "action": "offset",
}
"""Settings of the weighted kernel as for the finger gait."""
EXACT: dict[str, float] = {"force_noise": 0.0, "force_hysteresis": 0.0, "force_dropout": 0.0}
"""Touch without errors."""
ROWS: dict[str, dict[str, Any]] = {
    "forces": EXACT,
    "cop": {"state": "cop", **EXACT},
    "tactile": {"state": "tactile", "width": 1.0, **EXACT},
    "constant": {
        "policy": f"{HERE}:Constant",
        "initial_sigma": 0.3,
        "action": "offset",
        "state": "joints",
    },
    "time": {"task": f"{HERE}:Blind", "sight": "time"},
    "joints": {"state": "joints"},
    "joints, offset": {"state": "joints", **WIDE},
    "joints+targets": {"task": f"{HERE}:Blind", "sight": "joints+targets"},
    "joints+targets, offset": {"task": f"{HERE}:Blind", "sight": "joints+targets", **WIDE},
    "joints+memory": {"task": f"{HERE}:Blind", "sight": "joints+memory", "width": 1.0},
}
TOUCH = ("forces", "cop", "tactile")
BY_HAND = {"expert": "by hand: joints' lag", "zeroed": "by hand: zeroed encoders"}
JUDGED: dict[str, dict[str, Any]] = {
    "": {"average": None, "shuffle": False},
    ", last mean": {"average": 1, "shuffle": False},
    ", shuffled": {"average": None, "shuffle": True},
}
"""The tested policies of each run: the average of its last means, as in the preset, and the last
mean alone.
"""


def main() -> None:
    """Learn, test, and write the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", default="20,21,22,23,24")
    parser.add_argument("--bias", type=float, default=0.05)
    parser.add_argument("--out", type=Path, default=Path("runs/touch"))
    parser.add_argument("--rows", default=",".join(name for name in ROWS if ", " not in name))
    arguments = parser.parse_args()
    seeds = [int(word) for word in arguments.seeds.split(",")]
    rows = [
        name
        for name in ROWS
        if name in arguments.rows.split(",") or name.split(", ")[0] in arguments.rows.split(",")
    ]
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"bias-{arguments.bias:g}.json"
    results: dict[str, list[float]] = json.loads(path.read_text()) if path.exists() else {}
    print(
        "| policy observes | success on 200 new starts, by seed [%] | last mean alone [%] | with"
        " shuffled touch [%] |"
    )
    print("|---|---|---|---|")
    for name, success in (("expert", _expert), ("zeroed", _zeroed)):
        if name not in results:
            results[name] = [success(arguments.bias)]
    for name in rows:
        for what, how in JUDGED.items():
            if f"{name}{what}" not in results and (name in TOUCH or not how["shuffle"]):
                results[f"{name}{what}"] = [
                    _learnt(name, seed, arguments.bias, **how) for seed in seeds
                ]
                path.write_text(json.dumps(results, indent=1) + "\n")
        cells = (_percent(results.get(f"{name}{what}", ())) for what in JUDGED)
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(f"| hand-made: rate and lag of the joints | {_percent(results['expert'])} | | |")
    print(
        f"| hand-made: zeroed encoders, force from deflections | {_percent(results['zeroed'])}"
        " | | |"
    )
    path.write_text(json.dumps(results, indent=1) + "\n")
    draw(results, arguments.out / f"bias-{arguments.bias:g}.png", arguments.bias)


def _percent(parts: Sequence[float]) -> str:
    return ", ".join(f"{100 * part:.3g}" for part in parts)


def _learnt(name: str, seed: int, bias: float, *, average: int | None, shuffle: bool) -> float:
    """Learn a run of a row, or continue it; return its success, optionally with the touch of a
    different rollout.
    """
    from running import learn  # workers load this file by its path alone

    options = {"task": "fragile-bar", **ROWS[name], "joint_bias": bias, "seed": seed}
    config = farm.configure(options.pop("task"), **options)
    folder = Path("runs/touch", f"{re.sub('[^a-z]+', '-', name)}-b{bias:g}-s{seed}")
    learn(config, folder, workers=2)
    runner = problem(config).runner()
    try:
        return _success(runner, loaded(RunFolder.open(folder), average=average).mu, shuffle=shuffle)
    finally:
        runner.close()


def _success(runner: Runner, mean: FloatArray, *, shuffle: bool) -> float:
    """Share of the new starts that succeed; optionally each rollout gets the touch of its
    neighbour in the batch.
    """
    done, size = [], runner.sim.engine.size
    for first in range(0, len(STARTS), size):
        starts = STARTS[first : first + size]

        def rollouts(starts: tuple[Seed, ...] = starts) -> Any:  # noqa: ANN401
            batch = Batch(runner.task, runner.sim, starts)
            prepared = runner.policy.prepare(np.tile(mean, (len(starts), 1)))
            while not batch.over:
                x = batch.observe()
                batch.step(
                    runner.policy.act(
                        prepared[batch.active], np.roll(x, 1, axis=0) if shuffle else x
                    )
                )
            return batch.rollouts()

        done.append(again(rollouts).success)
    return float(np.concatenate(done).mean())


def _expert(bias: float) -> float:
    """Success of the best hand-made policy without touch: close until the middle finger's joints
    lag enough.
    """
    runner = problem(farm.configure("fragile-bar", joint_bias=bias)).runner()
    middle = FINGER_JOINTS["middle"]

    def judge(starts: tuple[Seed, ...], rate: float, lag: float) -> float:
        done = []
        for first in range(0, len(starts), runner.sim.engine.size):

            def rollouts(
                group: tuple[Seed, ...] = starts[first : first + runner.sim.engine.size],
            ) -> Any:  # noqa: ANN401
                batch, sim = Batch(runner.task, runner.sim, group), runner.sim
                while not batch.over:
                    q = sim.qpos[:, : len(JOINTS)] + sim.own["noise"][:, sim.t]
                    behind = (sim.own["target"] - q)[:, middle].sum(axis=1)
                    action = np.zeros((len(sim), len(JOINTS)))
                    action[:, middle] = np.where(behind < lag, rate, 0.0)[:, None]
                    batch.step(action)
                return batch.rollouts()

            done.append(again(rollouts).success)
        return float(np.concatenate(done).mean())

    try:
        grid = itertools.product(
            (0.01, 0.015, 0.02, 0.03, 0.05), np.linspace(-0.1, 0.3, 21).tolist()
        )
        best = max(grid, key=lambda each: judge(GRID, *each))
        return judge(STARTS, *best)
    finally:
        runner.close()


class Zeroed:
    """A controller without touch that measures the servos' deflection from its own zero.

    It holds still for STILL steps, averages target - reading of every joint, and subtracts this
    zero afterwards, so that a constant error of the readings cancels. A linear map of the eight
    deflections, fitted to the forces of other starts, estimates the middle finger's force F; the
    finger then moves by clip(0.04 (0.9 N - F), +-0.03 rad) per step.
    """

    # Steps, rad/N, rad, share of the last estimate that is kept
    STILL, GAIN, MOST, KEEP = (4, 0.04, 0.03, 0.7)

    def __init__(self, runner: Runner, starts: Sequence[Seed]) -> None:
        """Fit the map (9,) on rollouts that close the finger at a constant rate, and then on its
        own ones.
        """
        self.runner, self.map = runner, np.zeros(len(JOINTS) + 1)
        for rate in (0.01, None):
            x, force = (values[:, self.STILL :] for values in self.rollouts(starts, rate)[1:])
            good = (force < BREAKS) & ~np.isnan(x).any(axis=-1)
            self.map = np.linalg.lstsq(
                np.insert(x[good], 0, 1.0, axis=-1), force[good], rcond=None
            )[0]

    def rollouts(self, starts: Sequence[Seed], rate: float | None = None) -> tuple[AnyArray, ...]:
        """Rollouts that follow the estimate, or close at a constant rate [rad per step].

        Returns:
          success (B,), deflections less their zero (B, steps, 8) [rad], nan after a rollout's end,
          and the middle finger's force (B, steps) [N].
        """
        size = self.runner.sim.engine.size
        parts = [
            again(partial(self._once, starts[i : i + size], rate))
            for i in range(0, len(starts), size)
        ]
        return tuple(np.concatenate(values) for values in zip(*parts, strict=True))

    def _once(self, starts: Sequence[Seed], rate: float | None) -> tuple[AnyArray, ...]:
        batch, sim = Batch(self.runner.task, self.runner.sim, tuple(starts)), self.runner.sim
        deflections = np.full((len(starts), self.runner.task.steps, len(JOINTS)), np.nan)
        zero, estimate = np.zeros((len(starts), len(JOINTS))), np.zeros(len(starts))
        while not batch.over:
            rows = batch.active
            reading = sim.qpos[:, : len(JOINTS)] + sim.own["noise"][:, sim.t]
            deflection = sim.own["target"] - reading - zero[rows]
            action = np.zeros((len(sim), len(JOINTS)))
            if sim.t < self.STILL:
                deflections[rows, sim.t] = deflection
                if sim.t == self.STILL - 1:
                    zero = np.nan_to_num(deflections[:, : self.STILL].mean(axis=1))
            else:
                deflections[rows, sim.t] = deflection
                force = self.map[0] + deflection @ self.map[1:]
                estimate[rows] = self.KEEP * estimate[rows] + (1.0 - self.KEEP) * force
                step = np.clip(self.GAIN * (WANTED - estimate[rows]), -self.MOST, self.MOST)
                action[:, FINGER_JOINTS["middle"]] = (
                    step if rate is None else np.full(len(sim), rate)
                )[:, None]
            batch.step(action)
        rollouts = batch.rollouts()
        return (
            rollouts.success,
            deflections,
            rollouts.frames["force"].sum(axis=-1)[..., FINGERS.index("middle")],
        )


def _zeroed(bias: float) -> float:
    """Success of the controller that zeroes its encoders."""
    runner = problem(farm.configure("fragile-bar", joint_bias=bias)).runner()
    try:
        return float(Zeroed(runner, FITS).rollouts(STARTS)[0].mean())
    finally:
        runner.close()


def draw(results: dict[str, list[float]], path: Path, bias: float) -> None:
    """One figure: success by the policy's observation, one dot per seed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4))
    names = [name for name in results if not name.endswith(", last mean")]
    names.sort(key=lambda name: name not in BY_HAND)
    for row, name in enumerate(names):
        touch = name.split(", ")[0] in TOUCH and "shuffled" not in name
        colour = "#0072b2" if touch else "#999999"
        medians = [
            float(np.median(results[each]))
            for each in (name, f"{name}, last mean")
            if each in results
        ]
        axes.barh(row, 100 * max(medians), color=colour, alpha=0.5)
        for suffix, fill in (("", colour), (", last mean", "none")):
            parts = [100 * part for part in results.get(f"{name}{suffix}", ())]
            axes.plot(
                parts,
                [row] * len(parts),
                "o",
                markeredgecolor=colour,
                markerfacecolor=fill,
                markersize=4,
            )
    axes.set_yticks(range(len(names)), [BY_HAND.get(name, name) for name in names])
    axes.set_xlim(0, 101)
    axes.set_xlabel(
        "success on 200 new starts [%]\ndots: seeds; rings: their last means alone; bars: the"
        " better median"
    )
    axes.set_title(f"fragile bar, joint readings off by {bias:g} rad; blue: with touch")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    from running import script

    script(main)
