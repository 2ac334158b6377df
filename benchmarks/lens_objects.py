"""Learns to turn several objects with one policy, and tries it with each of them and with others;
one table.

    python benchmarks/lens_objects.py [--seen touch phase] [--seeds 22,23] [--starts 100]
        [--seconds 60] [--runs runs/lens] [--out FILE.jsonl] [--table]

Task, search and settings are those of `lens.py`; each pair of rollouts has one of the objects of
`MET`. The policy does not know which. The start grip, the kinematics and what touch takes for zero
are those of each object. Rows that are in the file are not measured again, finished runs are not
repeated, and interrupted ones continue.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from lens import SEEN, learnt, tried
from lens_elsewhere import written
from running import keep, rows_of, script, table_flags, trial_flags

from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from learner.tools.replay.loaded import LoadedPolicy, load

HERE: Final = Path(__file__).parent
TABLE: Final = HERE.parent / "docs/results/tables/lens-objects.jsonl"
MET: Final = (
    "lens of 80 x 22 mm, 50 g",
    "lens of 70 x 40 mm, 60 g",
    "lens of 90 x 26 mm, 80 g",
    "can of 50 x 40 mm, 60 g",
    "hexagon of 50 x 30 mm, 60 g",
)
"""Objects that a policy learns with."""
NOT_MET: Final = (
    "lens of 70 x 22 mm, 40 g",
    "lens of 85 x 34 mm, 110 g",
    "cube of 45 mm, 85 g",
)


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/lens"), [22, 23])
    trial_flags(parser, starts=100, seconds=60, least=10)
    parser.add_argument("--seen", nargs="*", choices=SEEN, default=["touch", "phase"])
    arguments = parser.parse_args()
    asked = {"starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked, "object")
    if not arguments.table:
        done = {(row["seen"], row["seed"], row["object"]) for row in rows}
        steps = round(arguments.seconds / CONTROL_PERIOD)
        folder = arguments.runs / "objects"
        files = {name: str(written(name, folder)) for name in (*MET, *NOT_MET)}
        met = tuple(files[name] for name in MET)
        for seed in arguments.seeds:
            for seen in arguments.seen:
                run = learnt("Lens", seen, seed, arguments.runs, f"{seen}-of-several", object=met)
                for name, file in files.items():
                    if (seen, seed, name) not in done:
                        policy: LoadedPolicy = load(run, steps=steps, object=file)
                        row = {**asked, "seen": seen, "seed": seed, "object": name}
                        rows.append(row | tried(policy, arguments.starts))
                        keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A row for each object and what is seen; numbers of the seeds in order."""
    yield "| object | met | what is seen | kept to the end [%] | turns, least | median |"
    yield "|---|---|---|---|---|---|"
    for name in (*MET, *NOT_MET):
        for seen in SEEN:
            those = [row for row in rows if (row["object"], row["seen"]) == (name, seen)]
            if those:
                those.sort(key=lambda row: int(row["seed"]))
                kept = ", ".join(f"{100 * row['kept'][-1] / row['starts']:g}" for row in those)
                least, median = (
                    ", ".join(f"{round(row[each], 1) + 0.0:.1f}" for row in those)
                    for each in ("least", "median")
                )
                met = "yes" if name in MET else "no"
                yield f"| {name} | {met} | {seen} | {kept} | {least} | {median} |"


if __name__ == "__main__":
    script(main)
