"""Learns to turn a lens by touch without one part of the method at a time; one table.

    python benchmarks/lens_ablations.py [--seeds 22,23,24,25,26] [--without symmetry stages ...]
        [--starts 100] [--seconds 120] [--runs runs/lens] [--out FILE.jsonl] [--table]

The first row is the whole method, that of `lens.py`, whose runs it uses. Each other row differs
from it by the settings of `WITHOUT`, and has as many generations of as many rollouts. Policies are
tried as in `lens.py`. Rows that are in the file are not measured again, finished runs are not
repeated, and interrupted ones continue.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from lens import learnt, tried
from running import keep, rows_of, script, table_flags, trial_flags

from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from learner.tools.replay.loaded import LoadedPolicy, load

HERE: Final = Path(__file__).parent
TABLE: Final = HERE.parent / "docs/results/tables/lens-ablations.jsonl"
GENERATIONS: Final = 180  # those of the task's preset
WITHOUT: Final[Mapping[str, tuple[str, str, Mapping[str, Any]]]] = {
    "nothing": ("nothing", "the whole method", {}),
    "average": ("averaging", "the last mean of the same runs", {}),
    "phases": ("phases", "one answer to touch in the whole cycle", {"phases": False}),
    "symmetry": (
        "symmetry",
        "all is explored from the first generation",
        {"symmetry": False, "less": 1.0},
    ),
    "stages": ("the second stage", "coarse to the end", {"coarse": GENERATIONS}),
    "long": ("long rollouts", "7.2 s instead of 16", {"steps": 72}),
    "cost": ("a reward for the pose", "only turning and loss count", {"cost": 0.0}),
    "curved": ("curved faces", "a plate", {"object": "plate"}),
    "own": ("starts of each pair's own", "four that a generation shares", {"shared_starts": 4}),
}
"""Parts of the method: a row's first two cells, and the settings without the part."""
PARTS: Final = list(WITHOUT)[1:]


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/lens"), list(range(22, 27)))
    trial_flags(parser, starts=100, seconds=120, least=10)
    parser.add_argument("--without", nargs="*", choices=PARTS, default=PARTS)
    arguments = parser.parse_args()
    asked = {"starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked, "without")
    if not arguments.table:
        done = {(row["without"], row["seed"]) for row in rows}
        steps = round(arguments.seconds / CONTROL_PERIOD)
        for seed in arguments.seeds:
            for without in dict.fromkeys(("nothing", *arguments.without)):
                if (without, seed) not in done:
                    policy = _policy(without, seed, arguments.runs, steps)
                    row = {**asked, "without": without, "seed": seed}
                    rows.append(row | tried(policy, arguments.starts))
                    keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def _policy(without: str, seed: int, runs: Path, steps: int) -> LoadedPolicy:
    """The final policy of a run without a part of the method, learnt if it is not there."""
    if without in ("nothing", "average"):
        run = learnt("Lens", "touch", seed, runs)
        return load(run, GENERATIONS if without == "average" else None, steps=steps)
    settings = WITHOUT[without][2]
    run = learnt("Lens", "touch", seed, runs, f"touch-without-{without}", **settings)
    return load(run, steps=steps)


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A row for each part that is left out; numbers of the seeds in order."""
    yield "| without | instead | kept to the end [%] | turns, median |"
    yield "|---|---|---|---|"
    for without, (part, instead, _) in WITHOUT.items():
        those = [row for row in rows if row["without"] == without]
        if those:
            those.sort(key=lambda row: int(row["seed"]))
            kept = ", ".join(f"{100 * row['kept'][-1] / row['starts']:g}" for row in those)
            turns = ", ".join(f"{round(row['median'], 1) + 0.0:.1f}" for row in those)
            yield f"| {part} | {instead} | {kept} | {turns} |"


if __name__ == "__main__":
    script(main)
