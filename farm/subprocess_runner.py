"""Runs one run's jobs in a separate process: the owner's side of `farm.runner_process`."""

import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from farm.arrays import FloatArray
from farm.errors import FarmError, MessageError, UnservedError
from farm.net.work import NOT_NORMALISED, Jobs, Simulated
from farm.processes import ONE_THREAD
from farm.runner_process import Answer, Begin, Order, receive, send

log = logging.getLogger(__name__)

_BEGIN: Final = 60.0  # [s] to import the code and build the task
_JOBS: Final = 300.0  # [s] for a chunk: the worker waits meanwhile
_KEPT: Final = (
    *("PATH", "PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TZ"),
    *("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"),
)
"""Environment variables passed to the process; the rest may hold secrets."""


class RunnerProcess:
    """A process that has imported the farm and waits for a run.

    It has executed no received code yet.
    """

    def __init__(self, folder: Path, python: Sequence[str] = ()) -> None:
        """Start it in a folder.

        Args:
          folder: working directory.
          python: command of a Python whose code is trusted: the process has this one's environment,
              and may be on another machine. Without, it has few variables, and this Python.
        """
        self._link, far_end = socket.socketpair()
        module = ("-P", "-m", "farm.runner_process")
        with far_end:
            number = far_end.fileno()
            try:
                if python:
                    self._process = subprocess.Popen(
                        [*python, *module, "-"],
                        stdin=number,
                        stdout=number,
                        cwd=folder,
                        env={**os.environ, **ONE_THREAD},
                        start_new_session=True,
                    )
                else:
                    self._process = subprocess.Popen(
                        [sys.executable, *module, str(number)],
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                        cwd=folder,
                        env={name: os.environ[name] for name in _KEPT if name in os.environ},
                        pass_fds=(number,),
                        start_new_session=True,
                    )
            except OSError:
                self._link.close()
                raise
        self.pid = self._process.pid

    def ask(self, message: Begin | Order, seconds: float) -> Answer:
        """Send a message and wait for the reply.

        Raises:
          FarmError: the code raised, with its traceback, or the process died.
          UnservedError: the run cannot be served, or no reply arrived in time.
        """
        try:
            send(self._link, message, seconds)
            answer = receive(self._link, Answer, seconds)
        except TimeoutError:
            self.close()
            raise UnservedError(
                f"its code did not answer within {seconds:g} s and was stopped"
            ) from None
        except (OSError, MessageError) as error:
            self.close()
            kind = UnservedError if isinstance(message, Begin) else FarmError
            raise kind(
                f"the process that runs its code ended (status {self._process.returncode}): {error}"
            ) from None
        if answer.error:
            raised = FarmError(answer.error) if answer.served else UnservedError(answer.error)
            raised.traceback = answer.traceback
            raise raised
        return answer

    @property
    def ended(self) -> bool:
        """Whether the process was closed, or died."""
        return self._process.poll() is not None

    def close(self) -> None:
        """Kill the process and its children."""
        if not self.ended:
            with suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)
            self._process.wait()
        self._link.close()


class SubprocessRunner:
    """Runs one run's jobs as `farm.runner.Runner` does, in a process that is restarted if it
    dies.
    """

    def __init__(
        self,
        begin: Begin,
        folder: Path,
        process: RunnerProcess | None = None,
        python: Sequence[str] = (),
    ) -> None:
        """Build the task in the process.

        Args:
          begin: what the run simulates.
          folder: working directory of its processes; an empty one for code that was received.
          process: one that is already waiting.
          python: of its processes, as in RunnerProcess.

        Raises:
          UnservedError: the task cannot be built; with the reason, and the traceback if the code
              raised.
        """
        self._begin = begin
        self._folder = folder
        self._python = python
        if process is not None and process.ended:
            process.close()
            process = None
        answer = self._start(process or RunnerProcess(folder, python))
        self.size = answer.size
        """Number of policy parameters, P."""
        self.fingerprint = answer.fingerprint
        """How the process's machine rounds, if `begin` asks for it."""

    @property
    def pid(self) -> int:
        """Process id of the runner."""
        return self._process.pid

    def run(
        self,
        mu: FloatArray,
        jobs: Jobs,
        traces: str = "none",
        normaliser: FloatArray = NOT_NORMALISED,
        *,
        terms: bool = False,
    ) -> Simulated:
        """Run jobs around a mean (P,); as `Runner.run`.

        Raises:
          FarmError: the code raised, with its traceback, or its process died.
          UnservedError: it does not answer, or cannot be restarted.
        """
        if self._process.ended:
            self._process.close()
            self._start(RunnerProcess(self._folder, self._python))
        order = Order(jobs=jobs, traces=traces, mu=mu, normaliser=normaliser, terms=terms)
        results = self._process.ask(order, _JOBS).results
        if results is None:
            raise FarmError("the process that runs the run's code returned no results")
        return results

    @property
    def ended(self) -> bool:
        """Whether the process has died; the next jobs start another."""
        return self._process.ended

    def close(self) -> None:
        """End the process."""
        self._process.close()

    def _start(self, process: RunnerProcess) -> Answer:
        self._process = process
        try:
            return process.ask(self._begin, _BEGIN)
        except FarmError:
            process.close()
            raise
