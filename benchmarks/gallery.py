"""Learns the tasks of examples/, measures them beside trivial policies, films them, and writes
docs/gallery.md.

    python benchmarks/gallery.py [--only arm,cart] [--seed 0] [--runs runs/gallery] [--docs docs]

Each task is learnt by the command that the page shows; a run that is there is not repeated. The
scores are mean returns from 100 perturbed starts that no learning has seen:

    learnt      the run's last mean policy
    constant    the best of 50 random constant actions, each tried on 5 starts
    still       the policy whose parameters are all 0

Rows are kept in docs/results/tables/gallery.jsonl, films in docs/pictures/gallery. Needs the extras
`gym` and `video`, and what the heads of the robots' files and docs/gymnasium.md say.
"""

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from own_tasks import SEED, STARTS, constant, still
from PIL import Image, ImageSequence
from running import script

from farm.sim.video import palette
from learner.run.evaluation import evaluation_jobs
from learner.tools.replay.loaded import LoadedPolicy, load

ROOT: Final = Path(__file__).parents[1]
SECONDS: Final = 5.0  # of a film
SIZE: Final = (320, 240)  # of a film [pixels]
COLOURS: Final = 128  # a film may show something small for a part of its time only
LOSSY: Final = 40  # how much gifsicle may change, in its own unit
_WIDTH: Final = 96  # characters of a line of a command
TRIES: Final = (50, 5)  # constant actions, starts of each


@dataclass(frozen=True)
class Piece:
    """A task of the gallery."""

    task: str
    what: str
    flags: str = ""
    """Of `farm run`, beside the task."""
    needs: str = ""
    """What else is to be installed."""
    title: str = ""
    """Of its section; empty: after the module's name."""
    folder: str = "tasks"
    """Of examples/."""
    start: int | None = None
    """Of the film, as `farm evaluate` counts perturbed starts; None: the nominal one."""
    pictures: int | None = None
    """How many pictures its film has, the first ones; None: all."""

    @property
    def name(self) -> str:
        """Of its files: the title's, or the module's."""
        return self.title.lower().replace(" ", "_") or self.task.partition(".py")[0]

    @property
    def words(self) -> list[str]:
        """The command that learns it."""
        return ["run", "--task", f"examples/{self.folder}/{self.task}", *shlex.split(self.flags)]


_ROBOT: Final = "Its model: [robots of other people](../examples/README.md#robots-of-other-people)."

PIECES: Final = (
    Piece(
        "go1.py:Walk",
        "A Unitree Go1 trots at a commanded speed.",
        "--generations 60",
        needs=_ROBOT,
        folder="robots",
        pictures=42,
    ),
    Piece(
        "crazyflie.py:Hover",
        "A Crazyflie recovers from a tumble, and hovers.",
        needs=_ROBOT,
        folder="robots",
        start=3,
    ),
    Piece(
        "ur5e.py:Push",
        "A UR5e pushes a puck to its goal, within 3 cm from nearly all of its starts.",
        needs=_ROBOT,
        title="UR5e",
        folder="robots",
        start=1,
    ),
    Piece(
        "leap.py:Turn",
        "A LEAP hand turns a can in its palm, one and a half times in 10 s, and goes on.",
        "--generations 60 --policy linear --algorithm snes --initial-sigma 0.5",
        needs=_ROBOT,
        title="LEAP hand",
        folder="robots",
        pictures=50,
    ),
    Piece(
        "lens.py:Cube",
        "An Allegro hand turns a cube with its fingertips, 1.6 times in 10 s, and goes on.",
        "--algorithm examples/tasks/lens.py:Stages",
        title="Cube",
        pictures=50,
    ),
    Piece(
        "pendulum.py:Pendulum",
        "A motor that is too weak to lift a pendulum swings it up.",
        "--generations 150",
    ),
    Piece("cart.py:Cart", "A cart balances a pole of random mass."),
    Piece(
        "arm.py:Arm",
        "An arm follows a ball; the circle and its speed are random.",
        "--generations 300",
    ),
    Piece(
        "hopper.py:Hopper",
        "A planar hopper of random weight hops on random ground.",
        "--generations 300",
        pictures=50,
    ),
    Piece("quadrotor.py:Quadrotor", "A quadrotor flies to a point and hovers there."),
    Piece(
        "jaco.py:Jaco",
        "A Kinova arm with its meshes follows a ball.",
        "--generations 60",
        needs=_ROBOT,
    ),
    Piece(
        "gripper.py:Gripper",
        "A gripper lifts a box of unknown weight by touch.",
        "--policy linear --normalise --algorithm ars --learning-rate-mu 0.1 --initial-sigma 0.1"
        " --touch-noise 0.05 --touch-delay 1",
    ),
    Piece(
        "shadow_hand.py:Hold",
        "A goal environment: the Shadow hand holds a block so that many touch sensors feel it.",
        "--generations 10",
        needs=(
            "Package: [environments of other"
            " packages](gymnasium.md#environments-of-other-packages)."
        ),
    ),
    Piece("grips.py:Grips", "The Allegro hand adds its middle finger to a grip."),
)


def main() -> None:
    """Compute the rows that are missing, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default=",".join(piece.name for piece in PIECES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, default=Path("runs/gallery"))
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    arguments = parser.parse_args()
    films = arguments.docs / "pictures/gallery"
    films.mkdir(parents=True, exist_ok=True)
    file = arguments.docs / "results/tables/gallery.jsonl"
    rows = (
        {row["task"]: row for row in map(json.loads, file.read_text().splitlines())}
        if file.exists()
        else {}
    )
    for piece in PIECES:
        if piece.name in arguments.only.split(","):
            run = arguments.runs / f"{piece.name}-s{arguments.seed}"
            rows[piece.task] = measured(piece, run, arguments.seed)
            film(piece, run, films / f"{piece.name}.gif", load(run))
            file.write_text(
                "".join(json.dumps(rows[each.task]) + "\n" for each in PIECES if each.task in rows)
            )
    (arguments.docs / "gallery.md").write_text(page(rows), "utf-8")


def measured(piece: Piece, run: Path, seed: int) -> dict[str, Any]:
    """A row: what the run cost, and its score beside trivial policies."""
    if not run.exists():
        _farm(
            *piece.words,
            "--seed",
            str(seed),
            "--out",
            str(run.parent),
            "--name",
            run.name,
            "--no-record",
        )
    summary, policy = json.loads((run / "summary.json").read_text()), load(run)
    returns = policy.runner.run(policy.mu, evaluation_jobs(STARTS, SEED)).returns[:STARTS]
    task = f"{ROOT}/examples/{piece.folder}/{piece.task}"
    scores = {
        "learnt": float(returns.mean()),
        "constant": constant(task, 0, 0, *TRIES),
        "still": still(task, 0, 0),
    }
    row = {
        "task": piece.task,
        "seed": seed,
        "rollouts": summary["rollouts"],
        "seconds": round(summary["seconds"]),
    }
    return row | {name: round(score, 3) for name, score in scores.items()}


def film(piece: Piece, run: Path, path: Path, policy: LoadedPolicy) -> None:
    """The run's policy from the nominal start, or a perturbed one, in a small file."""
    task = policy.problem.task
    speed = task.steps * task.period / SECONDS
    which = [] if piece.start is None else ["--seed", str(piece.start)]
    _farm(
        "replay",
        str(run),
        "--video",
        str(path),
        "--speed",
        str(speed),
        "--to",
        str(run / "film.rrd"),
        *which,
    )
    frames: list[Image.Image] = []
    durations: list[int] = []  # for how long [ms]; equal frames are one
    with Image.open(path) as large:
        for at, frame in enumerate(ImageSequence.Iterator(large)):
            if at % 2:
                durations[-1] += frame.info["duration"]
            else:
                frames.append(frame.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS))
                durations.append(frame.info["duration"])
    frames = frames[: piece.pictures]
    durations = durations[: piece.pictures]
    common = palette(frames, COLOURS)
    first, *rest = [frame.quantize(palette=common, dither=Image.Dither.NONE) for frame in frames]
    first.save(path, save_all=True, append_images=rest, duration=durations, loop=0, optimize=True)
    if shutil.which("gifsicle"):  # nearly the same pictures in a smaller file
        smaller = ["gifsicle", "-O3", f"--lossy={LOSSY}", str(path), "-o", str(path)]
        subprocess.run(smaller, check=True)


def page(rows: dict[str, Any]) -> str:
    """docs/gallery.md."""
    lines = [
        "# Gallery",
        "",
        (
            "Each task is one file in `examples`. The command below its film learnt it on two"
            " cores. Films are played so that a whole rollout lasts five seconds; some show its"
            " first part. Scores are mean"
        ),
        (
            "returns from 100 perturbed starts that no learning has seen; *constant* is the best of"
            " 50 random constant"
        ),
        (
            "actions, each tried on 5 starts only, and *still* the policy whose parameters are"
            " all 0. `python benchmarks/gallery.py` repeats all of it."
        ),
    ]
    for piece in PIECES:
        if (row := rows.get(piece.task)) is None:
            continue
        scores = ", ".join(
            f"{name} {_short(row[name])}" for name in ("learnt", "constant", "still")
        )
        title = piece.title or piece.name.replace("_", " ").capitalize()
        lines += ["", f"## {title}", "", f"![{piece.what}](pictures/gallery/{piece.name}.gif)", ""]
        cost = f"after {row['rollouts']} rollouts, {row['seconds']} s. {piece.needs}".rstrip()
        lines += [f"{piece.what} **{scores}** {cost}", ""]
        command = textwrap.wrap(
            f"farm {shlex.join(piece.words)}",
            _WIDTH,
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines += [" \\\n        ".join([f"    {command[0]}", *command[1:]])]
    return "\n".join(lines) + "\n"


def _short(score: float) -> str:
    return f"{score:.3g}" if abs(score) < 100 else f"{score:.0f}"


def _farm(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "farm", *words], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    script(main)
