"""Replaces touch by an estimate from the joints' readings, in policies that turn a lens by touch;
one table.

    python benchmarks/lens_estimate.py [--seeds 22,23] [--noise 0,0.01] [--starts 200]
        [--seconds 120] [--runs runs/lens] [--out FILE.jsonl] [--table]

This is the strongest opponent of touch. The estimate of what touch would tell is a linear function
of all joints' deflections in the last cycle, with weights for each phase of it. The weights are
fitted by least squares to rollouts of 40 s: first of policies near the learnt one, which see touch;
then, nine times, of the learnt one, which sees the estimate and so meets other states (DAgger, Ross
et al. 2011). In the first cycle, which has no history, touch is seen.

Policies are those of `lens.py`, learnt if they are not there, and tried from its starts. Each
reading of a joint has noise with the standard deviation `--noise` [rad]. Rows that are in the file
are not measured again.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from lens import kept_in, learnt, tried, turns_in
from running import decimals, keep, rows_of, script, table_flags, trial_flags

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.sim.sim import Sim
from farm.tasks.finger_gait import hand
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from learner.tools.replay.loaded import LoadedPolicy, load

TABLE: Final = Path(__file__).parents[1] / "docs/results/tables/lens-estimate.jsonl"
CYCLE: Final = 16  # control steps of a cycle
NUMBERS: Final = 4  # of touch
JOINTS: Final = len(hand.JOINTS)
ROUNDS: Final = 10
ROLLOUTS: Final = 200  # in each round
STEPS: Final = 400  # control steps of such a rollout
SPREAD: Final = 0.01  # standard deviation of the first round's parameters [cm]
RIDGE: Final = 1e-4  # penalty of the weights, as a share of the deflections' variance


class Estimate:
    """What touch would tell, as a linear function of the joints' deflections in the last cycle."""

    def __init__(self) -> None:
        width = CYCLE * JOINTS + 1  # the deflections and a 1
        self._weights: FloatArray | None = None  # for each phase, (CYCLE, width, NUMBERS)
        # Sums over the control steps of each phase, of deflections x and of what touch tells, y
        self._xx = np.zeros((CYCLE, width, width))
        self._xy = np.zeros((CYCLE, width, NUMBERS))
        self._yy = np.zeros((CYCLE, NUMBERS))

    def install(self, policy: LoadedPolicy) -> None:
        """Replace the touch that a policy sees: by this estimate once it is fitted, and after the
        first cycle.
        """
        task: Any = policy.runner.task
        touch = task.seen

        def seen(sim: Sim) -> FloatArray:
            numbers: FloatArray = touch(sim)
            before = sim.own.get("deflections", np.zeros((len(sim), CYCLE * JOINTS)))
            now = np.concatenate([task.deflections(sim), before[:, :-JOINTS]], axis=1)
            sim.own["deflections"] = now
            if sim.t < CYCLE:
                return numbers
            x = np.column_stack([now, np.ones(len(sim))])
            self._note(sim.t % CYCLE, x, numbers)
            return numbers if self._weights is None else x @ self._weights[sim.t % CYCLE]

        task.seen = seen

    def _note(self, phase: int, x: FloatArray, y: FloatArray) -> None:
        self._xx[phase] += x.T @ x
        self._xy[phase] += x.T @ y
        self._yy[phase] += (y**2).sum(axis=0)

    def fit(self) -> None:
        """Fit the weights to all that was seen so far."""
        scale = np.trace(self._xx[:, :-1, :-1], axis1=1, axis2=2).mean() / (CYCLE * JOINTS)
        ridge = np.diag([*np.full(CYCLE * JOINTS, RIDGE * scale), 0.0])
        weights = np.linalg.solve(self._xx + ridge, self._xy)
        self._weights = np.asarray(weights.round(3), dtype=np.float64)  # hides how LAPACK rounds

    def share(self) -> float:
        """The share of touch's variance that the estimate explains in all that was seen so far."""
        assert self._weights is not None
        model = (self._weights * (self._xx @ self._weights)).sum(axis=1)
        errors = self._yy - 2.0 * (self._weights * self._xy).sum(axis=1) + model
        variance = self._yy - self._xy[:, -1] ** 2 / self._xx[:, -1, -1, None]
        return float(1.0 - errors.sum() / variance.sum())


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/lens"), [22, 23])
    trial_flags(parser, starts=200, seconds=120, least=40)
    parser.add_argument("--noise", type=decimals, default=[0.0, 0.01])
    arguments = parser.parse_args()
    asked = {"starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked, "noise")
    if not arguments.table:
        done = {(row["noise"], row["seed"]) for row in rows}
        for noise in arguments.noise:
            for seed in arguments.seeds:
                if (noise, seed) not in done:
                    run = learnt("Lens", "touch", seed, arguments.runs)
                    row = {**asked, "noise": noise, "seed": seed}
                    rows.append(row | with_estimate(run, noise, arguments))
                    keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def with_estimate(run: Path, noise: float, arguments: argparse.Namespace) -> dict[str, Any]:
    """What becomes of lenses with an estimate in touch's place, and how good it is."""
    policy = load(run, steps=STEPS, joint_noise=noise)
    long = load(run, steps=round(arguments.seconds / CONTROL_PERIOD), joint_noise=noise)
    estimate = Estimate()
    estimate.install(policy)
    rng = np.random.default_rng(0)
    thetas = policy.mu + SPREAD * rng.standard_normal((ROLLOUTS, policy.mu.size))
    for number in range(ROUNDS):
        starts = [streams.evaluation_start(3 + number, i) for i in range(ROLLOUTS)]
        policy.runner.rollouts(thetas, starts)
        estimate.fit()
        thetas = np.tile(policy.mu, (ROLLOUTS, 1))
    share = round(estimate.share(), 3)
    estimate.install(long)
    return {"explained": share, **tried(long, arguments.starts)}


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The rows by noise and by seed."""
    yield (
        "| noise of the joints' readings [rad] | seed | touch's variance that is explained | turns,"
        " least / 5 % / median / most | kept for 40 s [%] | to the end [%], 95 % interval |"
    )
    yield "|---|---|---|---|---|---|"
    for row in sorted(rows, key=lambda row: (row["noise"], row["seed"])):
        yield (
            f"| {row['noise']:g} | {row['seed']} | {row['explained']:.2f} | {turns_in(row)} |"
            f" {100 * row['kept'][3] / row['starts']:g} | {kept_in(row)} |"
        )


if __name__ == "__main__":
    script(main)
