"""Gives policies that turn a lens by touch an estimate from the joints in touch's place; one table.

    python benchmarks/lens_estimate.py [--seeds 22,23,24] [--noise 0,0.01] [--starts 200]
        [--seconds 120] [--runs runs/lens] [--out FILE.jsonl] [--table]

The strongest opponent of touch: a policy that learnt with touch goes on with an estimate of what
touch would tell, a linear function of all joints' deflections in the last cycle, with weights for
each phase. These are fitted by least squares to rollouts of 40 s: of the policy with touch and
slightly other parameters, and then, nine times, with the estimate in its place, which meets other
states (DAgger, Ross et al. 2011). In the first cycle, which has no history, touch is given.

Policies are those of `lens.py`, learnt if they are not there, and tried from its starts. Each
reading of a joint has noise of this standard deviation [rad]. Rows that are in the file are not
measured again.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from lens import learnt, tried
from running import keep, rows_of, script
from touch_map import wilson

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.sim.sim import Sim
from farm.tasks.finger_gait import hand
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from learner.tools.replay.loaded import LoadedPolicy, load

TABLE: Final = Path(__file__).parents[1] / "docs/results/tables/lens-estimate.jsonl"
CYCLE: Final = 16  # control steps
TOLD: Final = 4  # numbers of touch
JOINTS: Final = len(hand.JOINTS)
ROUNDS: Final = 10
FITTED: Final = 200  # rollouts of a round
STEPS: Final = 400  # of each
OTHER: Final = 0.01  # standard deviation of the first round's parameters [cm]
SHRINKING: Final = 1e-4  # of the weights, as a share of the deflections' variance


class Estimate:
    """What touch would tell, from the joints' deflections in the last cycle, in place of touch."""

    def __init__(self) -> None:
        self._task: Any = None
        width = CYCLE * JOINTS + 1  # the deflections and a 1
        self._weights: FloatArray | None = None  # for each phase, (CYCLE, width, TOLD)
        # Sums over the control steps of each phase: of deflections x and of what touch tells, y
        self._xx = np.zeros((CYCLE, width, width))
        self._xy = np.zeros((CYCLE, width, TOLD))
        self._yy = np.zeros((CYCLE, TOLD))

    def replaces_touch(self, policy: LoadedPolicy) -> None:
        """Be what this policy sees, in place of touch."""
        task: Any = policy.runner.task
        self._task, self._touch = task, task.seen
        task.seen = self.seen

    def seen(self, sim: Sim) -> FloatArray:
        """The estimate, (B, TOLD); touch before there is one, and in the first cycle."""
        told: FloatArray = self._touch(sim)
        now = self._task.joints(sim) - sim.own["target"] - self._task.sag
        before = sim.own.get("deflections", np.zeros((len(sim), CYCLE * JOINTS)))
        sim.own["deflections"] = np.concatenate([now, before[:, :-JOINTS]], axis=1)
        if sim.t < CYCLE:
            return told
        x = np.column_stack([sim.own["deflections"], np.ones(len(sim))])
        phase = sim.t % CYCLE
        self._xx[phase] += x.T @ x
        self._xy[phase] += x.T @ told
        self._yy[phase] += (told**2).sum(axis=0)
        return told if self._weights is None else x @ self._weights[phase]

    def fit(self) -> None:
        """Fit the weights to all that was seen so far."""
        scale = np.trace(self._xx[:, :-1, :-1], axis1=1, axis2=2).mean() / (CYCLE * JOINTS)
        shrinking = np.diag([*np.full(CYCLE * JOINTS, SHRINKING * scale), 0.0])
        weights = np.linalg.solve(self._xx + shrinking, self._xy)
        self._weights = np.asarray(weights.round(3), dtype=np.float64)  # hides how LAPACK rounds

    def explained(self) -> float:
        """The share of the variance of what touch tells that the estimate explains."""
        assert self._weights is not None
        fitted = (self._weights * (self._xx @ self._weights)).sum(axis=1)
        wrong = self._yy - 2.0 * (self._weights * self._xy).sum(axis=1) + fitted
        varying = self._yy - self._xy[:, -1] ** 2 / self._xx[:, -1, -1, None]
        return float(1.0 - wrong.sum() / varying.sum())


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seeds", type=lambda text: list(map(int, text.split(","))), default=[22, 23, 24]
    )
    parser.add_argument(
        "--noise", type=lambda text: list(map(float, text.split(","))), default=[0.0, 0.01]
    )
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--seconds", type=int, default=120)
    parser.add_argument("--runs", type=Path, default=Path("runs/lens"))
    parser.add_argument("--out", type=Path, default=TABLE)
    parser.add_argument(
        "--table", action="store_true", help="print the file's table and measure nothing"
    )
    arguments = parser.parse_args()
    if arguments.seconds < 10 or arguments.seconds % 10:
        parser.error("--seconds: expected 10, 20, 30, ...")
    asked = {"starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked)
    if not arguments.table:
        done = {(row["noise"], row["seed"]) for row in rows}
        for noise in arguments.noise:
            for seed in arguments.seeds:
                if (noise, seed) not in done:
                    run = learnt("Lens", "touch", seed, arguments.runs)
                    row = {**asked, "noise": noise, "seed": seed}
                    rows.append(row | estimated(run, noise, arguments))
                    keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def estimated(run: Path, noise: float, arguments: argparse.Namespace) -> dict[str, Any]:
    """What becomes of lenses with an estimate in touch's place, and how good it is."""
    policy = load(run, steps=STEPS, joint_noise=noise)
    estimate = Estimate()
    estimate.replaces_touch(policy)
    thetas = policy.mu + OTHER * np.random.default_rng(0).standard_normal((FITTED, len(policy.mu)))
    for number in range(ROUNDS):
        starts = [streams.evaluation_start(3 + number, i) for i in range(FITTED)]
        policy.runner.rollouts(thetas, starts)
        estimate.fit()
        thetas = np.tile(policy.mu, (FITTED, 1))
    explained = round(estimate.explained(), 3)
    long = load(run, steps=round(arguments.seconds / CONTROL_PERIOD), joint_noise=noise)
    estimate.replaces_touch(long)
    return {"explained": explained, **tried(long, arguments.starts)}


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The rows by noise and by seed."""
    yield (
        "| noise of the joints' readings [rad] | seed | variance that is explained | turns, least /"
        " 5 % / median / most | kept for 40 s [%] | to the end [%], 95 % interval |"
    )
    yield "|---|---|---|---|---|---|"
    for row in sorted(rows, key=lambda row: (row["noise"], row["seed"])):
        starts, kept = row["starts"], row["kept"]
        low, high = (max(0.0, 100 * bound) for bound in wilson(kept[-1], starts))
        turns = " / ".join(f"{row[each]:.1f}" for each in ("least", "low", "median", "most"))
        yield (
            f"| {row['noise']:g} | {row['seed']} | {row['explained']:.2f} | {turns} |"
            f" {100 * kept[3] / starts:g} | {100 * kept[-1] / starts:g} ({low:.0f} to {high:.0f}) |"
        )


if __name__ == "__main__":
    script(main)
