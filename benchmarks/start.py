"""How long commands take until a user sees something, and what importing takes.

    python benchmarks/start.py [--turns 7]

Each command is a new process, in turns with the others; medians, lowest to highest in parentheses.
The first generation of a run is seen when its line is printed, that of a worker when the learner,
which waits for it, prints the same line. Processor time is that of the command's process and of
what it has started.
"""

import argparse
import contextlib
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Final

from running import script

from farm.errors import FarmError
from farm.net.session import free_endpoint

FARM: Final = (sys.executable, "-m", "farm")
FIRST: Final = "generation  1/"
"""How the line of the first generation begins."""
RUN: Final = ("--no-record", "--generations", "20", "--out")
IMPORTS: Final = (
    "farm",
    "learner.run.launch",
    "mujoco",
    "numpy",
    "zenoh",
    "msgpack",
    "tyro",
    "rerun",
)


def main() -> None:
    """Measure, and print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=7)
    turns = parser.parse_args().turns
    commands = {
        "python, nothing": lambda: whole(sys.executable, "-c", ""),
        "farm --help": lambda: whole(*FARM, "--help"),
        "farm run --help": lambda: whole(*FARM, "run", "--help"),
        "farm run --seed -1": lambda: whole(*FARM, "run", "--seed", "-1", status=2),
        "farm tasks": lambda: whole(*FARM, "tasks"),
        "farm run: first generation": first_of_a_run,
        "farm worker: first generation": first_of_a_worker,
    }
    imports = {name: partial(whole, sys.executable, "-c", f"import {name}") for name in IMPORTS}
    for what, measures in (("command", commands), ("import", imports)):
        print(f"\n| {what} | s | core-s |\n|---|---|---|")
        for name, times in measured(measures, turns):
            print(f"| {name} | {shown(times, 0)} | {shown(times, 1)} |", flush=True)


def measured(
    commands: Mapping[str, Callable[[], float]], turns: int
) -> Iterator[tuple[str, list[tuple[float, float]]]]:
    """Wall and processor time of each command [s], in turns."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for _ in range(turns):
        for name, command in commands.items():
            before = processor_time()
            seconds = command()
            times[name].append((seconds, processor_time() - before))
    yield from times.items()


def shown(of_turns: list[tuple[float, float]], which: int) -> str:
    """Median and range of the wall (0) or processor times (1)."""
    values = [each[which] for each in of_turns]
    return f"{statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def processor_time() -> float:
    """Of all processes that were started here and have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def whole(*command: str, status: int = 0) -> float:
    """Seconds until a command has ended.

    Raises:
      FarmError: its exit status is another.
    """
    begun = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - begun
    if done.returncode != status:
        raise FarmError(f"{' '.join(command)} ended with status {done.returncode}: {done.stderr}")
    return seconds


def first_of_a_run() -> float:
    """Seconds from the start of a run until its first generation."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        with started("run", *RUN, folder) as run:
            until(run, FIRST)
            seconds = time.perf_counter() - begun
            run.communicate()
    return seconds


def first_of_a_worker() -> float:
    """Seconds from the start of a worker until its learner, which waits, has a generation."""
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        with started("learner", "--listen", endpoint, *RUN, folder) as learner:
            until(learner, "run ")
            begun = time.perf_counter()
            with started("worker", "--connect", endpoint, "--workers", "2") as worker:
                until(learner, FIRST)
                seconds = time.perf_counter() - begun
                learner.communicate()
                worker.terminate()
                worker.communicate()
    return seconds


@contextlib.contextmanager
def started(*words: str) -> Iterator["subprocess.Popen[str]"]:
    """A command that runs, with its output in one stream; killed if it is not over at the end."""
    process = subprocess.Popen(
        (*FARM, *words),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def until(process: "subprocess.Popen[str]", text: str) -> None:
    """Read lines until one begins like this.

    Raises:
      FarmError: the command ended before.
    """
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        if line.startswith(text):
            return
        lines.append(line)
    raise FarmError(f"no line begins with {text!r}: {''.join(lines)}")


if __name__ == "__main__":
    script(main)
