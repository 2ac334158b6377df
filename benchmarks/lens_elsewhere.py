"""Tries policies that turn a lens or a cube with objects and errors that they never met; one table.

    python benchmarks/lens_elsewhere.py [--task Cube] [--seen exact] [--seeds 22,23] [--starts 100]
        [--seconds 60] [--runs runs/lens] [--out FILE.jsonl] [--table]

The policies are those of `lens.py`, learnt if they are not there. Starts are perturbed as in
learning, and not those of it. The grip of the start, the kinematics and what touch takes for zero
are computed with the changed object or servos. What is seen has new noise in every control step.
Rows that are in the file are not measured again.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from lens import SEEN, learnt, tried
from running import keep, rows_of, script, table_flags, trial_flags
from touch_map import SKINS

from learner.tools.replay.loaded import LoadedPolicy, load

HERE: Final = Path(__file__).parent
TABLE: Final = HERE.parent / "docs/results/tables/lens-elsewhere.jsonl"

SHAPES: Final[Mapping[str, tuple[str, str, float]]] = {
    "cube of 36 mm, 45 g": ("box", "0.018 0.018 0.018", 0.045),
    "cube of 45 mm, 85 g": ("box", "0.0225 0.0225 0.0225", 0.085),
    "cube of 50 mm, 120 g": ("box", "0.025 0.025 0.025", 0.12),
    "block of 50 x 50 x 26 mm, 40 g": ("box", "0.025 0.025 0.013", 0.04),
    "block of 40 x 40 x 50 mm, 80 g": ("box", "0.02 0.02 0.025", 0.08),
    "block of 40 x 56 x 40 mm, 80 g": ("box", "0.02 0.028 0.02", 0.08),
    "can of 50 x 40 mm, 60 g": ("cylinder", "0.025 0.02", 0.06),
    "lens of 70 x 40 mm, 60 g": ("ellipsoid", "0.035 0.035 0.02", 0.06),
    "lens of 70 x 22 mm, 40 g": ("ellipsoid", "0.035 0.035 0.011", 0.04),
    "lens of 90 x 26 mm, 80 g": ("ellipsoid", "0.045 0.045 0.013", 0.08),
}
"""Objects: kind of geometry, its sizes as MuJoCo has them [m], and its mass [kg]."""
OTHERS: Final[Mapping[str, tuple[str, str, float]]] = {
    "lens of 80 x 22 mm, 50 g": ("ellipsoid", "0.04 0.04 0.011", 0.05),
    "lens of 85 x 34 mm, 110 g": ("ellipsoid", "0.0425 0.0425 0.017", 0.11),
    "hexagon of 50 x 30 mm, 60 g": ("hexagon", "0.01443 0.025 0.015", 0.06),
}
"""Objects of `lens_objects.py` beside these; a hexagon by one of its three boxes."""
ERRORS: Final[Mapping[str, Mapping[str, Any]]] = {
    "as learnt": {},
    "friction 0.7": {"friction": 0.7},
    "friction 1.4": {"friction": 1.4},
    "servos of 0.8 the stiffness": {"stiffness": 0.8},
    "servos of 1.3 the stiffness": {"stiffness": 1.3},
    "starts twice as far off": {"displacement": 0.008, "tilt": 0.1},
    "noise of 1 mm and 0.02 rad in what is seen": {"blur": 0.2},
    "noise of 2.5 mm and 0.05 rad": {"blur": 0.5},
    "good touch": SKINS["good touch"],
    "poor touch": SKINS["poor touch"],
    "good touch, friction 0.7, stiffness 0.8": {
        **SKINS["good touch"],
        "friction": 0.7,
        "stiffness": 0.8,
    },
}
"""Settings that differ from those of learning."""


def main() -> None:
    """Learn and try what is missing, and print the table."""
    parser = table_flags(__doc__, TABLE, Path("runs/lens"), [22, 23])
    trial_flags(parser, starts=100, seconds=60, least=10)
    parser.add_argument("--task", choices=("Lens", "Cube"), default="Cube")
    parser.add_argument("--seen", choices=SEEN, default="exact")
    arguments = parser.parse_args()
    asked = {"starts": arguments.starts, "seconds": arguments.seconds}
    rows = rows_of(arguments.out, asked, "with")
    if not arguments.table:
        steps = arguments.seconds * 10
        objects: dict[str, Mapping[str, Any]] = {
            name: {"object": str(written(name, arguments.runs / "objects"))} for name in SHAPES
        }
        for seed in arguments.seeds:
            run = learnt(arguments.task, arguments.seen, seed, arguments.runs)
            for name, settings in {**ERRORS, **objects}.items():
                if arguments.seen != "touch" and any("force" in key for key in settings):
                    continue
                of = {"task": arguments.task, "seen": arguments.seen, "seed": seed}
                row = {**asked, **of, "with": name}
                if not any(all(each[key] == row[key] for key in row) for each in rows):
                    policy: LoadedPolicy = load(run, steps=steps, **settings)
                    rows.append(row | tried(policy, arguments.starts))
                    keep(arguments.out, rows[-1])
    print("\n".join(table(rows)))


def written(name: str, folder: Path) -> Path:
    """The file of an object, which is written into a folder."""
    kind, size, mass = {**SHAPES, **OTHERS}[name]
    # A hexagon's faces are those of three boxes
    kind, angles = ("box", (0, 60, 120)) if kind == "hexagon" else (kind, (0,))
    geometries = "\n".join(
        f"""      <geom name="part_{angle}" type="{kind}" size="{size}" euler="0 0 {angle}"
            mass="{mass / len(angles)}" contype="2" conaffinity="1" condim="4" priority="1"
            friction="1 0.002 0.001" rgba="0.9 0.62 0.1 1"/>"""
        for angle in angles
    )
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / (name.partition(",")[0].replace(" ", "-") + ".xml")
    file.write_text(
        f"""<mujoco model="object">
  <worldbody>
    <body name="object" pos="0.08 0.04 0.02">
      <freejoint name="object"/>
{geometries}
    </body>
  </worldbody>
</mujoco>
"""
    )
    return file


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """A row for each condition; numbers of the seeds in order."""
    yield "| task, what is seen | with | kept to the end [%] | turns, least | median |"
    yield "|---|---|---|---|---|"
    for name in dict.fromkeys((row["task"], row["seen"], row["with"]) for row in rows):
        those = [row for row in rows if (row["task"], row["seen"], row["with"]) == name]
        kept = ", ".join(f"{100 * row['kept'][-1] / row['starts']:g}" for row in those)
        least, median = (
            ", ".join(f"{round(row[each], 1) + 0.0:.1f}" for row in those)
            for each in ("least", "median")
        )
        yield f"| {name[0]}, {name[1]} | {name[2]} | {kept} | {least} | {median} |"


if __name__ == "__main__":
    script(main)
