"""Learns to turn a lens with touch and without, and counts its turns until it is lost; one table.

    python benchmarks/lens.py [--task Cube] [--seeds 22,23,24,25,26] [--seen touch joints ...]
        [--starts 200] [--seconds 720] [--shuffled] [--runs runs/lens] [--out FILE.jsonl] [--table]
        [--figure FILE.svg]

The task and its search are those of `examples/tasks/lens.py`, with its own settings for all. The
first row holds still. The others learn from scratch what to do in each phase of a cycle (phase), or
also a linear function of the joints' deflections (joints, with noise as everywhere, and without),
of what touch tells of the lens's place and tilt (touch), or of the true place and tilt (exact).
Each policy is tried on starts that were not used for training. With --shuffled it also gets the
readings of a different rollout in the same phase. Rows that are in the file are not measured again,
finished runs are not repeated, and interrupted ones continue.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from running import keep, learn, rows_of, script, table_flags, trial_flags
from touch_map import wilson

from farm import seeds as streams
from farm.arrays import FloatArray
from farm.policies.base import Policy
from farm.sim.engines import CAPACITY
from farm.tasks import loop
from farm.tasks.finger_gait.hand import JOINTS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from farm.tasks.finger_gait.turning import turned
from farm.tasks.rollouts import Rollouts
from learner import plots
from learner.run import setup
from learner.run.config import RunConfig, configure
from learner.tools.replay.loaded import LoadedPolicy, load

HERE: Final = Path(__file__).parent
FILE: Final = HERE.parent / "examples/tasks/lens.py"
TABLE: Final = HERE.parent / "docs/results/tables/lens.jsonl"
SEEN: Final[Mapping[str, Mapping[str, Any]]] = {
    "touch": {"state": "touch"},
    "joints": {"state": "joints"},
    "joints without noise": {"state": "joints", "joint_noise": 0.0},
    "phase": {"state": "phase"},
    "exact": {"state": "exact"},
}
"""Settings of the task by what a policy sees."""
WAVES: Final = 9  # numbers of the observation before what is seen


class Shuffled:
    """A policy that sees what a different rollout of its batch sees in the same phase; the last one
    of a batch that is left sees nothing.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy

    def prepare(self, theta: FloatArray) -> FloatArray:
        """Prepare as the policy does."""
        return self._policy.prepare(theta)

    def act(self, prepared: FloatArray, x: FloatArray) -> FloatArray:
        """Actions (B, A) of observations (B, d), whose first numbers are the phase's."""
        seen = np.roll(x[:, WAVES:], 1, axis=0) if len(x) > 1 else np.zeros_like(x[:, WAVES:])
        return self._policy.act(prepared, np.concatenate([x[:, :WAVES], seen], axis=1))


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/lens"), list(range(22, 27)))
    trial_flags(parser, starts=200, seconds=720, least=120)
    parser.add_argument("--task", choices=("Lens", "Cube"), default="Lens")
    parser.add_argument("--seen", nargs="*", choices=SEEN, default=list(SEEN))
    parser.add_argument("--shuffled", action="store_true", help="try touch of other rollouts, too")
    parser.add_argument("--figure", type=Path, help="draw how many lenses are kept for how long")
    arguments = parser.parse_args()
    asked = {"task": arguments.task, "starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked, "seen")
    if not arguments.table:
        done = {(row["seen"], row["seed"], row["shuffled"]) for row in rows}
        steps = round(arguments.seconds / CONTROL_PERIOD)
        cells: list[tuple[str, int | None, bool]] = [("still", None, False)]
        for seed in arguments.seeds:
            for seen in arguments.seen:
                cells.append((seen, seed, False))
                if arguments.shuffled and seen != "phase":
                    cells.append((seen, seed, True))
        for seen, seed, shuffled in cells:
            if (seen, seed, shuffled) not in done:
                policy = _policy(arguments.task, seen, seed, arguments.runs, steps)
                row = {**asked, "seen": seen, "seed": seed, "shuffled": shuffled}
                rows.append(row | tried(policy, arguments.starts, shuffled=shuffled))
                keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))
    if arguments.figure is not None:
        draw(rows, arguments.figure)


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The rows by what is seen and by seed."""
    yield (
        "| what is seen | seed | starts | turns, least / 5 % / median / most | kept for 40 s [%] |"
        " 120 s | to the end [%], 95 % interval |"
    )
    yield "|---|---|---|---|---|---|---|"
    for row in sorted(rows, key=_place):
        seed = "-" if row["seed"] is None else row["seed"]
        starts = row["starts"]
        yield (
            f"| {_name(row)} | {seed} | {starts} | {turns_in(row)} |"
            f" {100 * row['kept'][3] / starts:g} | {100 * row['kept'][11] / starts:g} |"
            f" {kept_in(row)} |"
        )


def _place(row: Mapping[str, Any]) -> tuple[int, bool, int]:
    """Where a row is in the table."""
    return ("still", *SEEN).index(row["seen"]), row["shuffled"], row["seed"] or 0


def turns_in(row: Mapping[str, Any]) -> str:
    """The least, the 5 % quantile, the median and the largest number of turns of a row."""
    each = (row[name] for name in ("least", "low", "median", "most"))
    return " / ".join(f"{round(turns, 1) + 0.0:.1f}" for turns in each)


def kept_in(row: Mapping[str, Any]) -> str:
    """The share that a row keeps to the end, with its 95 % interval [%]."""
    kept = row["kept"][-1]
    low, high = (max(0.0, 100 * bound) for bound in wilson(kept, row["starts"]))
    return f"{100 * kept / row['starts']:g} ({low:.0f} to {high:.0f})"


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """A curve of survival for each policy: the share of lenses that are kept so long."""
    rows = sorted(rows, key=_place)
    names = list(dict.fromkeys(_name(row) for row in rows))
    looks = {
        name: {
            "color": plots.COLOURS[i % len(plots.COLOURS)],
            "linestyle": plots.DASHES[i // len(plots.COLOURS)],
        }
        for i, name in enumerate(names)
    }
    with plots.canvas(path, 6.0, 2.6) as figure:
        axes = figure.add_subplot(
            xlabel="time [s]", ylabel="lenses that are kept [%]", xscale="log"
        )
        for row in rows:
            kept = [100.0 * count / row["starts"] for count in row["kept"]]
            kept = kept[: kept.index(0.0) + 1] if 0.0 in kept else kept
            axes.plot(10 * np.arange(1, len(kept) + 1), kept, linewidth=1, **looks[_name(row)])
        axes.xaxis.set_major_formatter("{x:g}")
        for name, look in looks.items():
            axes.plot([], [], label=name, **look)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _name(row: Mapping[str, Any]) -> str:
    return row["seen"] + (", of another rollout" if row["shuffled"] else "")


def config_of(task: str, seen: str, seed: int, **changed: Any) -> RunConfig:  # noqa: ANN401
    """The configuration of a run."""
    settings = {**SEEN[seen], "algorithm": f"{FILE}:Stages", **changed}
    return configure(f"{FILE}:{task}", seed=seed, **settings)


def _policy(task: str, seen: str, seed: int | None, runs: Path, steps: int) -> LoadedPolicy:
    """The final policy of a run, which is learnt if it is not there; without a seed the grip of the
    start, held.
    """
    if seed is None:
        problem = setup.problem(configure(f"{FILE}:{task}", state="phase", steps=steps))
        return LoadedPolicy(problem, 0, np.zeros(problem.policy.size))
    return load(learnt(task, seen, seed, runs), steps=steps)


def learnt(
    task: str,
    seen: str,
    seed: int,
    runs: Path,
    name: str = "",
    **changed: Any,  # noqa: ANN401
) -> Path:
    """The folder of a finished run, which has a name of its own if some settings are changed."""
    folder = runs / f"{task}-{name or seen.replace(' ', '-')}-s{seed}".lower()
    learn(config_of(task, seen, seed, **changed), folder, workers=1)
    return folder


def tried(policy: LoadedPolicy, starts: int, *, shuffled: bool = False) -> dict[str, Any]:
    """Turns from each start until the lens is lost or time is over, their percentiles, and every 10
    s how many are kept.
    """
    runner = policy.runner
    seeds = [streams.evaluation_start(2, i) for i in range(starts)]
    turns_by_batch = []
    lasting_by_batch = []  # control steps, beyond the last one for a lens that is not lost
    for first in range(0, starts, CAPACITY):  # what minutes of all show would be many gigabytes
        those = seeds[first : first + CAPACITY]
        rollouts, _ = loop.run(
            runner.task,
            Shuffled(runner.policy) if shuffled else runner.policy,
            runner.sim,
            np.repeat(policy.mu[None], len(those), axis=0),
            those,
            runner.spec,
        )
        turns_by_batch.append(turns_of(rollouts))
        lasting_by_batch.append(rollouts.steps + ~(rollouts.ended | rollouts.failed))
    turns = np.concatenate(turns_by_batch)
    lasting = np.concatenate(lasting_by_batch)
    every = range(round(10 / CONTROL_PERIOD), turns.shape[1] + 1, round(10 / CONTROL_PERIOD))
    last = turns[:, -1]
    return {
        "least": round(float(last.min()), 2),
        "low": round(float(np.percentile(last, 5)), 2),
        "median": round(float(np.median(last)), 2),
        "most": round(float(last.max()), 2),
        "kept": [int((lasting > step).sum()) for step in every],
    }


def turns_of(rollouts: Rollouts) -> FloatArray:
    """Turns after each control step, constant from the loss on, (B, T)."""
    poses = (rollouts.start["qpos"][:, None], rollouts.frames["qpos"])
    pose = np.concatenate(poses, axis=1)[..., len(JOINTS) :]
    each = turned(pose)
    each[np.arange(each.shape[1]) >= rollouts.steps[:, None]] = 0.0
    return np.asarray(np.cumsum(each, axis=1) / (2.0 * np.pi))


if __name__ == "__main__":
    script(main)
