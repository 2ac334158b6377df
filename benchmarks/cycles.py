"""Learns a whole cycle of grips, and counts the cycles until the bar is lost; one table.

    python benchmarks/cycles.py [--seeds 20,21,22,23,24] [--states touch estimate ...]
        [--object crowned-bar] [--runs runs/cycles] [--out FILE.jsonl] [--table]

The task is `examples/tasks/cycle.py`. The first row is a script, the targets of the grips as they
are. The others learn what is added to these targets in each phase: the same for every cycle
(phase), and a linear function of the joints' deflections (joints), of an estimate of the bar's
place from these (estimate), or of where the fingertips were last touched (touch), with the task's
own settings for all. The estimate is the strongest opponent of touch: its weights are fitted to the
true place in rollouts of the script with small random additions, by least squares, and it averages
over some 20 control steps; once more with readings without noise (estimate-exact). Each final
policy is tried on 50 starts that were not used for training, for 1000 control steps (100 s), that
is 83 cycles at most. Rows that are in the file are not measured again, finished runs are not
repeated, and interrupted ones continue.
"""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import keep, learn, rows_of, script, table_flags

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.sim.sim import Sim
from farm.tasks.finger_gait.hand import JOINTS, TIP_RADIUS
from learner.run import setup
from learner.run.config import configure
from learner.tools.replay.loaded import LoadedPolicy, load

HERE: Final = Path(__file__).parent
TASK: Final = f"{HERE.parent / 'examples/tasks/cycle.py'}:Cycle"
TABLE: Final = HERE.parent / "docs/results/tables/cycles.jsonl"
STARTS: Final = 50
STEPS: Final = 1000
WANTED: Final = 25
FITTED: Final = 256  # rollouts to which the estimate is fitted
ADDED: Final = 0.01  # to the script's targets in these, standard deviation [rad]
SEEN: Final[Mapping[str, Mapping[str, Any]]] = {
    "script": {"state": "phase"},
    "touch": {"state": "touch"},
    "estimate": {"state": "estimate"},
    "estimate-exact": {"state": "estimate", "joint_noise": 0.0},
    "joints": {"state": "joints"},
    "phase": {"state": "phase"},
}
"""Settings of the task by what is seen."""


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/cycles"), list(range(20, 25)))
    parser.add_argument("--states", nargs="+", choices=list(SEEN)[1:], default=list(SEEN)[1:])
    parser.add_argument("--object", default="crowned-bar")
    arguments = parser.parse_args()
    rows = rows_of(arguments.out)
    if not arguments.table:
        done = {(row["object"], row["state"], row["seed"]) for row in rows}
        cells = [
            ("script", None),
            *((state, seed) for seed in arguments.seeds for state in arguments.states),
        ]
        for state, seed in cells:
            if (arguments.object, state, seed) not in done:
                policy = (
                    _script(arguments.object)
                    if seed is None
                    else _learnt(arguments.object, state, seed, arguments.runs)
                )
                rows.append(
                    {"object": arguments.object, "state": state, "seed": seed} | _tried(policy)
                )
                keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The rows by object, state and seed."""
    yield (
        "| bar | what is seen | seed | cycles, least / median / most | starts with at least"
        f" {WANTED} | never lost |"
    )
    yield "|---|---|---|---|---|---|"
    for row in sorted(
        rows, key=lambda row: (row["object"], list(SEEN).index(row["state"]), row["seed"])
    ):
        state, seed = (
            (row["state"], row["seed"]) if row["seed"] is not None else ("nothing: a script", "-")
        )
        cycles = f"{row['least']:g} / {row['median']:g} / {row['most']:g}"
        yield (
            f"| {row['object']} | {state} | {seed} | {cycles} | {row['reached']:.0%} |"
            f" {row['kept']:.0%} |"
        )


def _script(name: str) -> LoadedPolicy:
    """The grips' targets as they are."""
    problem = setup.problem(configure(TASK, **SEEN["script"], object=name, steps=STEPS))
    return LoadedPolicy(problem, 0, np.zeros(problem.policy.size))


def _learnt(name: str, state: str, seed: int, runs: Path) -> LoadedPolicy:
    """The final policy of a run, which is learnt if it is not there."""
    settings, run = {"object": name, **SEEN[state]}, runs / f"{name}-{state}-s{seed}"
    if settings["state"] == "estimate":
        settings["weights"] = estimate(settings)
    learn(configure(TASK, seed=seed, **settings), run, workers=2)
    return load(run, steps=STEPS)


def _tried(policy: LoadedPolicy) -> dict[str, float]:
    """Cycles from each start, and shares of the starts."""
    starts: list[Any] = [streams.evaluation_start(1, i) for i in range(STARTS)]
    rollouts = policy.runner.rollouts(np.repeat(policy.mu[None], STARTS, axis=0), starts)
    cycles: FloatArray = rollouts.measures[:, 0]
    return {
        "least": float(cycles.min()),
        "median": statistics.median(cycles.tolist()),
        "most": float(cycles.max()),
        "reached": float((cycles >= WANTED).mean()),
        "kept": float((rollouts.steps == STEPS).mean()),
    }


def estimate(settings: Mapping[str, Any]) -> tuple[float, ...]:
    """Weights (36,) of the state `estimate`: for each of the four grips, of eight deflections [rad]
    and a constant.

    Fitted to the bar's place along the fingers' way [fingertip radii], with the readings' noise, on
    starts that neither learning nor the table uses.
    """
    problem = setup.problem(configure(TASK, **{**settings, **SEEN["script"]}))
    task: Any = problem.task
    grips, observe = task.parts[0], task.observe
    averaged, places = [], []  # of each step (n, 36), averaged as the estimate will be, and (n,)

    def noted(sim: Sim) -> FloatArray:
        now = np.zeros((len(sim), grips, len(JOINTS) + 1))
        now[np.arange(len(sim)), sim.own["changes"] % grips] = np.column_stack(
            [task.deflections(sim), np.ones(len(sim))]
        )
        before = sim.own.get("averaged", np.zeros((len(sim), now[0].size)))
        sim.own["averaged"] = before + task.fresh * (now.reshape(before.shape) - before)
        averaged.append(sim.own["averaged"])
        places.append((sim.qpos[:, len(JOINTS)] - task.model.qpos0[len(JOINTS)]) / TIP_RADIUS)
        observed: FloatArray = observe(sim)
        return observed

    task.observe = noted
    policy = LoadedPolicy(problem, 0, np.zeros(problem.policy.size))
    added = ADDED * np.random.default_rng(0).standard_normal((FITTED, problem.policy.size))
    policy.runner.rollouts(added, [streams.evaluation_start(3, i) for i in range(FITTED)])
    weights = np.linalg.lstsq(np.concatenate(averaged), np.concatenate(places))[0]
    return tuple(weights.round(2).tolist())  # hides how LAPACK rounds


if __name__ == "__main__":
    script(main)
