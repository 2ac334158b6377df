"""Growth of a run with its generations, and what it writes for each; two tables.

    python benchmarks/long_runs.py [--generations 20000] [--task finger-gait] [--pairs 4]

`farm run` as typed, with two workers. The first table has times and memory in the second tenth and
in the last tenth of the generations (in the first one programs still load and chunks find their
length); the second one the size of each file divided by the generations.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from memory import megabytes
from running import script
from scaling import cpu


@dataclass(frozen=True)
class Sample:
    """A run at one moment."""

    generation: int
    learner: float
    """Processor time of the command's own process [s]."""
    others: float
    """Processor time of its workers [s]."""
    megabytes: float
    """Memory that the command's own process does not share [MB]."""


def main() -> None:
    """Run, and print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--generations", type=int, default=20_000)
    parser.add_argument("--task", default="finger-gait")
    parser.add_argument("--pairs", type=int, default=4)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "long")
        samples = watched(
            [
                *("--task", arguments.task, "--pairs", str(arguments.pairs)),
                *("--generations", str(arguments.generations), "--workers", "2", "--quiet"),
                *("--out", place, "--name", folder.name),
            ],
            folder / "progress.jsonl",
        )
        lines = (folder / "progress.jsonl").read_text("utf-8").splitlines()
        ends = [json.loads(line)["seconds"] for line in lines]
        sizes = {each.name: size(each) / len(lines) for each in sorted(folder.iterdir())}
    seconds = [after - before for before, after in pairwise(ends)]
    tenth = len(seconds) // 10
    early, late = seconds[tenth : 2 * tenth], seconds[-tenth:]
    parts = [[1e3 * statistics.median(each) for each in (early, late)]]
    at_ends = [between(samples, len(lines), 0.1, 0.2), between(samples, len(lines), 0.9, 1.0)]
    parts += [list(each) for each in zip(*at_ends, strict=True)]
    names = ("wall time [ms]", "learner [core-ms]", "workers [core-ms]", "memory [MB]")
    print("| per generation | second tenth | last tenth | ratio |\n|---|---|---|---|")
    for name, (first, last) in zip(names, parts, strict=True):
        print(f"| {name} | {first:.2f} | {last:.2f} | {last / first:.2f} |")
    print("\n| file | bytes per generation |\n|---|---|")
    for name, each in sorted(sizes.items(), key=lambda item: -item[1]):
        print(f"| `{name}` | {each:.0f} |")


def watched(words: list[str], progress: Path) -> list[Sample]:
    """Samples of `farm run`, ten per second, until it ends."""
    process = subprocess.Popen([sys.executable, "-P", "-m", "farm", "run", *words])
    over = threading.Event()
    threading.Thread(target=lambda: (process.wait(), over.set()), daemon=True).start()
    samples = []
    with process:
        try:
            while not over.wait(0.1):
                with suppress(OSError, ValueError):  # nothing is written yet, or one has ended
                    samples.append(sampled(process.pid, progress))
        finally:
            process.terminate()
    if process.returncode:
        raise SystemExit(process.returncode)
    return samples


def sampled(pid: int, progress: Path) -> Sample:
    """The run of this process now."""
    with progress.open("rb") as file:
        file.seek(max(0, progress.stat().st_size - 4096))
        text = file.read().decode()
    complete = text[: text.rfind("\n")].rpartition("\n")[2]
    children = [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return Sample(
        generation=int(json.loads(complete)["generation"]),
        learner=cpu(pid),
        others=sum(cpu(each) for each in children),
        megabytes=megabytes(pid)[0],
    )


def between(
    samples: list[Sample], generations: int, begin: float, end: float
) -> tuple[float, float, float]:
    """Processor time of learner and workers per generation [ms], and the memory [MB], between two
    shares of the run.
    """
    part = [
        each
        for each in samples  # workers leave after the last generation
        if begin <= each.generation / generations <= end and each.generation < generations
    ]
    first, last = part[0], part[-1]
    count = (last.generation - first.generation) / 1e3
    return (
        (last.learner - first.learner) / count,
        (last.others - first.others) / count,
        statistics.median(each.megabytes for each in part),
    )


def size(path: Path) -> float:
    """Bytes of a file, or of all files in a folder."""
    return sum(each.stat().st_size for each in files(path))


def files(path: Path) -> Iterator[Path]:
    """A file, or the files in a folder."""
    if path.is_dir():
        yield from (each for each in path.rglob("*") if each.is_file())
    else:
        yield path


if __name__ == "__main__":
    script(main)
