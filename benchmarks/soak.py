"""Soak test: a farm's workers are killed and started at random for a given time; checks the results
and the memory.

    python benchmarks/soak.py [--minutes 60] [--every 3]

While a learner runs and records, a worker is killed or a new one joins every few seconds (there are
always one to four). Then the same number of generations is learnt again without disturbance. The
hashes must agree, and neither the learner's threads nor its memory must have grown, except for the
rollouts that it keeps for recorders that join late. Otherwise the exit status is 1.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.config import RunConfig
from learner.run.launch import Outputs, open_run
from learner.telemetry import report_log as history

MOST = 4  # workers at a time


class Crowd:
    """The workers, and a thread that kills and starts them."""

    def __init__(self, endpoint: str, every: float) -> None:
        self.killed = self.joined = 0
        self.megabytes: list[float] = []
        self._command = [
            sys.executable,
            "-m",
            "workers",
            "--connect",
            endpoint,
            "--log-level",
            "ERROR",
        ]
        self._random, self._every = random.Random(0), every
        self._over = threading.Event()
        self._workers: list[subprocess.Popen[bytes]] = []
        self._thread = threading.Thread(target=self._live)
        self._thread.start()

    def close(self) -> None:
        """Stop all workers."""
        self._over.set()
        self._thread.join()
        for worker in self._workers:
            worker.terminate()
            worker.wait()

    def _live(self) -> None:
        self._join()
        while not self._over.wait(self._every):
            self.megabytes.append(max(_megabytes(worker.pid) for worker in self._workers))
            if len(self._workers) == MOST or (
                len(self._workers) > 1 and self._random.random() < 0.5
            ):
                self._kill()
            else:
                self._join()

    def _join(self) -> None:
        # In a process group of its own, so that only `close` ends it after Ctrl-C.
        self._workers.append(subprocess.Popen(self._command, process_group=0))
        self.joined += 1

    def _kill(self) -> None:
        worker = self._workers.pop(self._random.randrange(len(self._workers)))
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        self.killed += 1


def main() -> None:
    """Run the test, learn again, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument(
        "--every",
        type=float,
        default=3.0,
        help="seconds until the next worker is killed or started",
    )
    arguments = parser.parse_args()
    config = RunConfig(generations=1_000_000)
    with tempfile.TemporaryDirectory() as folder:
        path, seconds = Path(folder) / "soaked", arguments.minutes * 60
        soaked, crowd, learner, threads = _soak(config, path, seconds, arguments.every)
        calm = replace(config, generations=soaked["generations"])
        place = Placement(workers=2, listen=free_endpoint())
        with open_run(calm, Path(folder) / "calm", place) as run:
            for _ in run.learn():
                pass
    print(
        "| minutes | generations | rollouts | killed | joined | reissued | learner MB | threads |"
        " worker MB | same |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    print(
        f"| {arguments.minutes:g} | {soaked['generations']} | {soaked['rollouts']} | {crowd.killed}"
        f" | {crowd.joined} | {soaked['reissued']} | {_from_to(learner)} | {_from_to(threads)} |"
        f" {_from_to(crowd.megabytes)} |"
        f" {'yes' if soaked['parameters_sha256'] == run.summary['parameters_sha256'] else 'NO'} |"
    )
    if soaked["parameters_sha256"] != run.summary["parameters_sha256"]:
        sys.exit("the results differ from those without disturbance")
    if not _flat(learner, history.MEMORY / 1e6) or not _flat(crowd.megabytes):
        sys.exit("memory grows")
    if not _flat(threads):
        sys.exit("threads are left behind")


def _soak(
    config: RunConfig, path: Path, seconds: float, every: float
) -> tuple[dict[str, Any], Crowd, list[float], list[float]]:
    """The summary, the workers, and the learner's memory [MB] and threads over time."""
    until = time.monotonic() + seconds
    learner: list[float] = []
    threads: list[float] = []
    place = Placement(listen=free_endpoint())
    with open_run(
        config, path, place, Outputs(record=True), stopped=lambda: time.monotonic() > until
    ) as run:
        crowd = Crowd(place.listen, every)
        try:
            for report in run.learn():
                if (generation := report.progress.generation) % 20 == 0:
                    learner.append(_megabytes(os.getpid()))
                    threads.append(len([*Path("/proc/self/task").iterdir()]))
                if generation % 100 == 0:
                    left = (until - time.monotonic()) / 60
                    print(
                        f"generation {generation}, killed {crowd.killed}, {left:.1f} min left",
                        file=sys.stderr,
                    )
        finally:
            crowd.close()
    return run.summary, crowd, learner, threads


def _megabytes(pid: int) -> float:
    """Resident memory of a process; 0 when it has just ended."""
    try:
        return (
            int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            * os.sysconf("SC_PAGE_SIZE")
            / 1e6
        )
    except OSError:
        return 0.0


def _flat(megabytes: list[float], filling: float = 0.0) -> bool:
    """Whether memory in the last quarter is about that in the first, apart from buffers of this
    size [MB].
    """
    quarter = max(1, len(megabytes) // 4)
    return max(megabytes[-quarter:]) < 1.1 * max(megabytes[:quarter]) + 10 + filling


def _from_to(megabytes: list[float]) -> str:
    """Largest in the first and in the last quarter."""
    quarter = max(1, len(megabytes) // 4)
    return f"{max(megabytes[:quarter]):.0f} to {max(megabytes[-quarter:]):.0f}"


if __name__ == "__main__":
    from running import script

    script(main)
