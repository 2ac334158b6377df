"""Worker processes on this machine: started as subprocesses, never forked, stopped by pid."""

import logging
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

log = logging.getLogger(__name__)

_GRACE: Final = 1.5  # [s] for a worker to leave before it is killed
_RESTARTS: Final = 20  # a worker that keeps dying is not restarted forever
_ENVIRONMENT: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")


def end(processes: "Sequence[subprocess.Popen[Any]]", grace: float) -> None:
    """Ask processes to leave; those still running after this number of seconds are killed."""
    for process in processes:
        process.terminate()
    until = time.monotonic() + grace
    for process in processes:
        try:
            process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class LocalWorkers:
    """K processes `python -m workers`; one that dies is replaced."""

    def __init__(self, processes: int, arguments: Sequence[str], environment: dict[str, str]) -> None:
        """Start them with these arguments; they end when this process does, however it ends."""
        self._command = [sys.executable, "-P", "-m", "workers", *arguments, "--exit-with-parent"]
        # One thread per process: the cores are divided among processes.
        self._environment = {**environment, **dict.fromkeys(_ENVIRONMENT, "1")}
        self._restarts = 0
        self._missed: set[int] = set()
        self._processes = [self._start() for _ in range(processes)]

    def _start(self) -> "subprocess.Popen[bytes]":
        # Its standard input is a pipe that is never written to: it closes when this process ends.
        # In a separate session, which Ctrl-C on the terminal does not reach: this process ends its workers.
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, env=self._environment, start_new_session=True)

    @property
    def pids(self) -> list[int]:
        """Process ids of the running workers."""
        return [process.pid for process in self._processes if process.poll() is None]

    def tend(self) -> list[int]:
        """Replace workers that died; exit statuses of those that will not be replaced."""
        given_up = []
        for i, process in enumerate(self._processes):
            status = process.poll()
            if status is None:
                continue
            if status in (0, 1, 2) or self._restarts >= _RESTARTS:
                given_up.append(status)  # it ended by itself with a message, or keeps dying
                if process.pid not in self._missed:
                    self._missed.add(process.pid)
                    log.warning("worker process %d ended with status %d and is not replaced", process.pid, status)
                continue
            self._restarts += 1
            if process.stdin:
                process.stdin.close()
            log.warning("worker process %d ended with status %d; starting another", process.pid, status)
            self._processes[i] = self._start()
        return given_up

    def close(self) -> None:
        """Ask all to leave, wait, kill those that do not."""
        end(self._processes, _GRACE)
        for process in self._processes:
            if process.stdin:
                process.stdin.close()

    def __enter__(self) -> "LocalWorkers":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
