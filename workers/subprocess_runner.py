"""Code that came over the network, run in a process of its own: the worker's side of `workers.runner_process`."""

import logging
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from farm.arrays import FloatArray
from farm.errors import FarmError, MessageError, UnservedError
from farm.net.messages import Spec
from farm.net.work import NOT_NORMALISED, Jobs, Simulated
from workers.runner_process import Answer, Begin, Order, receive, send

log = logging.getLogger(__name__)

_BEGIN: Final = 60.0  # [s] to import the code and build the task
_JOBS: Final = 300.0  # [s] for a chunk: the worker does nothing else meanwhile
_KEPT: Final = (
    *("PATH", "PYTHONPATH", "PYTHONHOME", "LD_LIBRARY_PATH", "LANG", "LC_ALL", "TZ"),
    *("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"),
)
"""Variables that the process is told; no other, which may be a secret."""


class SubprocessRunner:
    """Runs one run's jobs as `farm.rollouts.Runner` does, in a process that is begun again where it dies."""

    def __init__(self, spec: Spec, files: tuple[Path, ...], backend: str, folder: Path) -> None:
        """Start it.

        Args:
          spec: what the run simulates.
          files: whose classes it may serve.
          backend: what simulates there.
          folder: where it runs; an empty one.

        Raises:
          UnservedError: the run cannot be served; says why, with the traceback where the code raised.
        """
        self._begin = Begin(spec=spec, files=tuple(map(str, files)), backend=backend)
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self.size = self._start()
        """Parameters of the policy, P."""

    @property
    def pid(self) -> int:
        """Of the process; 0 where none runs."""
        return 0 if self._process is None else self._process.pid

    def run(
        self, mu: FloatArray, jobs: Jobs, traces: str = "none", normaliser: FloatArray = NOT_NORMALISED
    ) -> Simulated:
        """Run jobs around a mean (P,); as `Runner.run`.

        Raises:
          FarmError: the code raised, with its traceback, or its process died.
          UnservedError: it does not answer.
        """
        if self._process is None:
            self._start()
        found = self._ask(Order(jobs=jobs, traces=traces, mu=mu, normaliser=normaliser), _JOBS).results
        if found is None:
            raise FarmError("the process that runs the run's code answered with no results")
        return Simulated(found.returns, found.flags, found.steps, found.traces, found.trajectories, found.moments)

    def close(self) -> None:
        """End the process and what it started."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._link.close()
            self._process = None

    def _start(self) -> int:
        self._link, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "workers.runner_process", str(theirs.fileno())],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=self._folder,
                env={name: os.environ[name] for name in _KEPT if name in os.environ}, pass_fds=(theirs.fileno(),),
                start_new_session=True,
            )  # fmt: skip
        return self._ask(self._begin, _BEGIN).size

    def _ask(self, message: Begin | Order, seconds: float) -> Answer:
        """Send a message and wait for what became of it."""
        assert self._process is not None
        try:
            send(self._link, message, seconds)
            answer = receive(self._link, Answer, seconds)
        except TimeoutError:
            self.close()
            raise UnservedError(f"its code did not answer within {seconds:g} s and was ended") from None
        except (OSError, MessageError) as error:
            process = self._process
            self.close()
            kind = UnservedError if isinstance(message, Begin) else FarmError
            raise kind(f"the process that runs its code ended (status {process.returncode}): {error}") from None
        if answer.error:
            if not answer.served:
                self.close()
            raised = FarmError(answer.error) if answer.served else UnservedError(answer.error)
            raised.traceback = answer.traceback
            raise raised
        return answer
