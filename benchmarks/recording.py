"""Measures what recording costs the learner, and the size of recordings.

    python benchmarks/recording.py [--blocks 4] [--repeats 3] [--long 500]

In a run with 15 pairs per generation, the middle two of every four blocks of 40 generations are
recorded. So other load and learning (rollouts take longer as fewer end early) affect blocks with
and without recording alike. A block ends when all of it is written. The run is recorded into a
file, and live: without a viewer, with a connected viewer, and with a viewer that no longer reads.
The table compares the median block's time per generation, and the processor time of the learner's
thread and of the recorder's.
"""

import argparse
import os
import platform
import signal
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import rerun_cli

from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.recording.drawing import Drawing
from learner.recording.run import RunRecording, open_recording
from learner.run.config import RunConfig, configure
from learner.run.launch import Outputs, Run, open_run

BLOCK = 40
"""Generations per block; the first four blocks of every run are left out."""

KINDS = {
    "into a file": "",
    "file and live, without a viewer": "live",
    "file and live, a viewer watches": "watches",
    "file and live, the viewer has stopped": "stopped",
}


@dataclass
class Times:
    """Measured times; each list has one number per block, which is that of one generation [ms]."""

    wall: list[float] = field(default_factory=list)
    """Duration."""
    thread: list[float] = field(default_factory=list)
    """Processor time of the learner's thread."""
    process: list[float] = field(default_factory=list)
    """Processor time of the learner's process."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--blocks", type=int, default=4, help="pairs of blocks per run, an even number"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--long", type=int, default=500, help="generations of the recording whose size is printed"
    )
    arguments = parser.parse_args()
    pairs = {name: (Times(), Times()) for name in KINDS}
    for repeat in range(arguments.repeats):
        for name, kind in KINDS.items():
            _run(
                configure(pairs=15, seed=repeat, generations=2 * BLOCK * (arguments.blocks + 2)),
                kind,
                *pairs[name],
            )
    print(
        f"{len(os.sched_getaffinity(0))} cores, {platform.machine()}, Python"
        f" {platform.python_version()}"
    )
    print(
        "\n| recorded | time per generation [ms] | recorded | longest | learner's thread | recorded"
        " | difference | recorder and Rerun |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, (without, with_) in pairs.items():
        wall, thread, process = (
            [statistics.median(getattr(times, what)) for times in (without, with_)]
            for what in ("wall", "thread", "process")
        )
        recorder = process[1] - process[0] - (thread[1] - thread[0])
        print(
            f"| {name} | {wall[0]:.1f} | {wall[1] / wall[0] - 1:+.1%} | {max(with_.wall):.0f} |"
            f" {thread[0]:.2f} | {thread[1]:.2f} | {(thread[1] - thread[0]) / wall[0]:+.1%} |"
            f" {recorder:.1f} |"
        )
    with tempfile.TemporaryDirectory() as folder:
        place = Placement(workers=2, listen=free_endpoint())
        with open_run(
            configure(pairs=15, generations=arguments.long),
            Path(folder, "r"),
            place,
            Outputs(record=True),
        ) as run:
            for _ in run.learn():
                pass
        size = Path(folder, "r", "run.rrd").stat().st_size
    print(
        f"\n{arguments.long} generations: {size / 2**20:.1f} MiB,"
        f" {size / arguments.long / 1000:.0f} kB each"
    )


def _run(config: RunConfig, kind: str, without: Times, with_: Times) -> None:
    """Learn, recording every other pair of blocks."""
    place = Placement(workers=2, listen=free_endpoint())
    port = int(free_endpoint().rpartition(":")[2])
    with tempfile.TemporaryDirectory() as folder, open_run(config, Path(folder, "r"), place) as run:
        opened = open_recording(
            Path(folder, "run.rrd"),
            run="r",
            config=config,
            drawing=Drawing.of(run.learner.problem),
            done=0,
            serve=("127.0.0.1", port) if kind else None,
        )
        with opened as recording, ExitStack() as stack:
            if kind in ("watches", "stopped"):
                stack.enter_context(_viewer(str(recording.uri), stopped=kind == "stopped"))
            _learn(run, recording, without, with_)


def _learn(run: Run, recording: RunRecording, without: Times, with_: Times) -> None:
    """Collect each block's times, except those of the first four."""
    before = _now()
    for report in run.learn():
        block, within = divmod(report.progress.generation, BLOCK)
        recorded = block % 4 in (1, 2)
        if recorded:
            recording.put(report)
        if within == BLOCK - 1:
            recording.settled()
            now = _now()
            times = with_ if recorded else without
            for values, a, b in zip(
                (times.wall, times.thread, times.process), before, now, strict=True
            ):
                if block >= 4:
                    values.append(1e3 * (b - a) / BLOCK)
            before = now


def _now() -> tuple[float, float, float]:
    return time.perf_counter(), time.thread_time(), time.process_time()


@contextmanager
def _viewer(uri: str, *, stopped: bool) -> Iterator[None]:
    """A viewer without a window that is connected; stopped: it no longer reads."""
    program, port = Path(rerun_cli.__file__).with_name("rerun"), free_endpoint().rpartition(":")[2]
    command = [str(program), uri, "--headless", "--bind", "127.0.0.1", "--port", port]
    with tempfile.TemporaryDirectory() as home:
        process = subprocess.Popen(
            command,
            env={**os.environ, "HOME": home},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            if stopped:
                time.sleep(2.0)  # by then it is connected
                os.kill(process.pid, signal.SIGSTOP)
            yield
        finally:
            process.kill()
            process.wait()


if __name__ == "__main__":
    from running import script

    script(main)
