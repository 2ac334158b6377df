"""Tells hands that turn a lens or a cube how fast, either way round, and to stop; one table of how
well they do.

    python benchmarks/steer.py [--task Cube] [--seeds 1,2,3] [--starts 100] [--runs runs/steer]
        [--out FILE.jsonl] [--table]

Learns with the command of `examples/tasks/steer.py`; its settings were chosen on seed 0. Each told
speed lasts for ten seconds, of which the last eight count: the mean speed of each start. Starts are
not those of learning. Rows that are in the file are not measured again, and finished runs not
repeated.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from lens import turns_of
from running import count, keep, learn, rows_of, script, table_flags

from farm import seeds as streams
from farm.tasks.finger_gait.holding import CONTROL_PERIOD
from learner.run.config import configure
from learner.tools.replay.loaded import load

HERE: Final = Path(__file__).parent
FILE: Final = HERE.parent / "examples/tasks/steer.py"
TABLE: Final = HERE.parent / "docs/results/tables/steer.jsonl"
PLAN: Final = (60.0, 30.0, -30.0, -60.0, 0.0, 45.0, 0.0, -45.0, 15.0, -15.0)
"""Speeds that are told in turn, clockwise [deg/s]."""
EACH: Final = round(10.0 / CONTROL_PERIOD)  # control steps of each
FIRST: Final = round(2.0 / CONTROL_PERIOD)  # of which these do not count


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/steer"), [1, 2, 3])
    parser.add_argument("--task", choices=("Lens", "Cube"), default="Cube")
    parser.add_argument("--starts", type=count, default=100)
    arguments = parser.parse_args()
    asked = {"task": arguments.task, "starts": arguments.starts}
    rows = rows_of(arguments.out, asked, "speeds")
    if not arguments.table:
        for seed in arguments.seeds:
            if all(row["seed"] != seed for row in rows):
                rows.append({**asked, "seed": seed, **tried(seed, arguments)})
                keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def tried(seed: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """How many objects are kept to the end, and the speeds of those [deg/s]: the least, the median
    and the largest for each that is told.
    """
    folder = arguments.runs / f"{arguments.task}-s{seed}".lower()
    config = configure(f"{FILE}:{arguments.task}", seed=seed, algorithm=f"{FILE}:Stages")
    learn(config, folder, workers=1)
    policy = load(folder, steps=EACH * len(PLAN), plan=PLAN)
    starts = [streams.evaluation_start(2, i) for i in range(arguments.starts)]
    rollouts = policy.runner.rollouts(np.tile(policy.mu, (len(starts), 1)), starts)
    kept = ~(rollouts.ended | rollouts.failed)
    turns = turns_of(rollouts)[kept]
    speeds: list[list[float] | None] = []  # None: no object is kept
    for i in range(len(PLAN)):
        first, last = turns[:, i * EACH + FIRST - 1], turns[:, (i + 1) * EACH - 1]
        speed = 360.0 * (last - first) / ((EACH - FIRST) * CONTROL_PERIOD)
        shares = np.percentile(speed, (0, 50, 100)).round(2).tolist() if len(speed) else None
        speeds.append(shares)
    return {"kept": int(kept.sum()), "speeds": speeds}


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A row for each speed that is told, a column for each seed."""
    seeds = " | ".join(f"seed {row['seed']}" for row in rows)
    yield f"| told [deg/s] | {seeds} |"
    yield "|---|" + "---|" * len(rows)
    for i, told in enumerate(PLAN):
        yield f"| {told:g} | {' | '.join(_cell(row['speeds'][i]) for row in rows)} |"
    kept = (f"{row['kept']} of {row['starts']}" for row in rows)
    yield f"| kept to the end | {' | '.join(kept)} |"


def _cell(speeds: Sequence[float] | None) -> str:
    """The median of the starts, the least and the largest."""
    if speeds is None:
        return "-"
    least, median, most = (round(each, 1) + 0.0 for each in speeds)
    return f"{median:.1f} ({least:.1f} to {most:.1f})"


if __name__ == "__main__":
    script(main)
