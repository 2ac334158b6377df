"""Worker processes on this machine: subprocesses, or forks of a process that has no threads yet;
stopped by pid.
"""

import gc
import json
import logging
import math
import os
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NoReturn

from farm import plugins
from farm.memory import give_back
from farm.net.forks import zenoh_ran

log = logging.getLogger(__name__)

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_GRACE: Final = 1.5  # [s] for a worker to leave before it is killed
_RESTARTS: Final = 20  # a worker that keeps dying is not restarted forever
ONE_THREAD: Final = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
"""Environment of a worker: the cores are divided among processes."""


_QUOTA: Final = Path("/sys/fs/cgroup/cpu.max")


def cores() -> int:
    """Cores that this process may use: those of its affinity, and not more than its container's
    share (cgroup v2).
    """
    count = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    with suppress(OSError, ValueError):  # no Linux, no limit ("max")
        quota, period = map(int, _QUOTA.read_text("ascii").split())
        count = min(count, max(1, math.ceil(quota / period)))
    return count


def usual_name() -> str:
    """The first part of the names of this machine's workers, unless they are told another."""
    host = socket.gethostname().split(".")[0]
    letters = "".join(c if c.isascii() and c.isalnum() else "-" for c in host)
    return letters.strip("-") or "host"


@contextmanager
def forks(count: int) -> "Iterator[list[Forked]]":
    """Processes that wait to become workers; none if this process must not fork: call it before
    there are threads.

    What this process has imported they share. But threads (Zenoh's, Rerun's, CUDA's, those of
    linear algebra) would be gone in a fork, and what they have locked would stay locked.
    """
    processes = _forks(count)
    try:
        yield processes
    finally:
        end(processes, _GRACE)


def _forks(count: int) -> "list[Forked]":
    threads = len(os.listdir("/proc/self/task")) if sys.platform == "linux" else 0  # noqa: PTH208
    if not count or threads != 1 or zenoh_ran():
        return []
    give_back()  # what is free now would be copied when forks use it
    gc.freeze()  # a collection in a fork would copy what it shares
    return [Forked() for _ in range(count)]


def default_signals_in_forks() -> None:
    """Let processes that a task forks from this one end at signals as others do, not as this one's
    handlers do.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_default_signals)


def _default_signals() -> None:
    for number in _SIGNALS:
        if callable(signal.getsignal(number)):  # those that are ignored, as by nohup, stay so
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            )


class Forked:
    """A process forked from this one; the part of `subprocess.Popen` that its owner needs."""

    def __init__(self) -> None:
        """Start it, in a session of its own; its standard input closes when this process ends."""
        source, sink = os.pipe()
        # The child must not handle them as this process
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        self.pid = os.fork()
        if not self.pid:
            os.dup2(source, 0)
            for number in _SIGNALS:
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            _become_worker()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.close(source)
        self.stdin = os.fdopen(sink, "wb", 0)
        self._status: int | None = None

    def begin(self, arguments: Sequence[str]) -> None:
        """Let it be `python -m workers` with these arguments."""
        with suppress(BrokenPipeError):  # it was killed
            self.stdin.write(json.dumps(arguments).encode() + b"\n")

    def poll(self) -> int | None:
        """Exit status of the process, negative if a signal ended it; None while it runs."""
        if self._status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it ends; a TimeoutExpired if it does not within some seconds."""
        until = None if timeout is None else time.monotonic() + timeout
        while (status := self.poll()) is None:
            if until is not None and time.monotonic() >= until:
                raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
            time.sleep(0.01)  # as subprocess does
        return status

    def terminate(self) -> None:
        """Ask it to end."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """End it."""
        self._send(signal.SIGKILL)

    def _send(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


def _become_worker() -> NoReturn:
    """Wait for arguments, and be a worker, in a forked process; it ends if there are none."""
    status = 0
    try:
        os.setsid()  # Ctrl-C on the terminal does not reach it
        # Close its siblings' inputs, which would stay open with it
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))
        logging.getLogger().handlers.clear()
        line = b""
        while not line.endswith(b"\n") and (byte := os.read(0, 1)):
            line += byte
        if line:
            status = plugins.load("workers.__main__").main(json.loads(line))
    except BaseException:
        traceback.print_exc()
        status = 1
    leave_nothing()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def end_group(leader: int) -> None:
    """End what is left of the group of a process that has ended or is to end: what its task has
    started.
    """
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def leave_nothing() -> None:
    """Ask the other processes of this one's group to end, if it is the leader: what a task has
    started in it.
    """
    if os.getpgid(0) == os.getpid():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(0, signal.SIGTERM)


def end(processes: "Sequence[subprocess.Popen[Any] | Forked]", grace: float) -> None:
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
        end_group(process.pid)


class LocalWorkers:
    """K worker processes; one that dies is replaced."""

    def __init__(
        self, processes: int, arguments: Sequence[str], forked: Sequence[Forked] = ()
    ) -> None:
        """Start them with these arguments; they end when this process does, however it ends.

        Args:
          processes: how many.
          arguments: of `python -m workers`.
          forked: processes that wait; without any, all are new ones.
        """
        self._arguments, self._forks = [*arguments, "--exit-with-parent"], bool(forked)
        self._restarts = 0
        self._missed: set[int] = set()
        waiting = [each for each in forked if each.poll() is None][:processes]
        for each in waiting:
            each.begin(self._arguments)
        self._processes = [*waiting, *(self._start() for _ in range(processes - len(waiting)))]
        self._ids = {process.pid for process in self._processes}

    def _start(self) -> "subprocess.Popen[bytes] | Forked":
        for each in _forks(1) if self._forks else ():
            each.begin(self._arguments)
            return each
        # Its standard input is a pipe that is never written to: it closes when this process ends.
        # In a separate session, which Ctrl-C on the terminal does not reach: this process ends its
        # workers.
        command = [sys.executable, "-P", "-m", "workers", *self._arguments]
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, env={**os.environ, **ONE_THREAD}, start_new_session=True
        )

    @property
    def pids(self) -> list[int]:
        """Process ids of the running workers."""
        return [process.pid for process in self._processes if process.poll() is None]

    def pid_of(self, worker: str) -> int | None:
        """Process id of one of these workers, which may have ended, by its name; None if it is
        none of them.
        """
        host, _, instance = worker.partition("/")
        digits = instance.partition("-")[0]  # as `Worker` names itself
        pid = int(digits) if digits.isdecimal() else 0
        return pid if host == usual_name() and pid in self._ids else None

    def kill(self, pid: int) -> bool:
        """End the worker with this id and what its task has started; false if there is none."""
        if pid not in self.pids:
            return False
        end_group(pid)
        return True

    def tend(self) -> list[int]:
        """Replace workers that died; exit statuses of those that will not be replaced."""
        given_up = []
        for i, process in enumerate(self._processes):
            status = process.poll()
            if status is None:
                continue
            if process.pid not in self._missed:
                end_group(process.pid)
            if status in (0, 1, 2) or self._restarts >= _RESTARTS:
                given_up.append(status)  # it ended by itself with a message, or keeps dying
                if process.pid not in self._missed:
                    self._missed.add(process.pid)
                    log.warning(
                        "worker process %d ended with status %d and is not replaced",
                        process.pid,
                        status,
                    )
                continue
            self._restarts += 1
            if process.stdin:
                process.stdin.close()
            log.warning(
                "worker process %d ended with status %d; starting another", process.pid, status
            )
            self._processes[i] = self._start()
            self._ids.add(self._processes[i].pid)
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
