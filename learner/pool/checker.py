"""The checker: a process of the learner's own that repeats jobs, and whose answers are right by
definition.

It is started when it is first needed, so that a run whose workers are all of this machine has none.
It has no network: its owner writes jobs to it and reads the results, so nobody else can answer in
its place. Where this machine cannot simulate, or rounds differently from the run, a command may
start it elsewhere (`--checker`).
"""

import queue
import shlex
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np

from farm.errors import FarmError, described
from farm.net.work import Jobs
from farm.runner_process import Begin
from farm.subprocess_runner import RunnerProcess, SubprocessRunner
from learner.pool.audit import Check, Finding
from learner.pool.round import bits

_TURN: Final = 0.5  # [s] of one message's jobs, so that a new best does not wait for long
_MOST: Final = 64  # jobs of a message
_ATTEMPTS: Final = 3  # to begin: the process may be killed
_LOOK: Final = 0.1  # [s] between two looks whether the thread has ended


class Checker:
    """Compares answers with its own, a few at a time, on a thread that waits for the process."""

    def __init__(
        self, begin: Callable[[Path], Begin], python: str, wake: Callable[[], object]
    ) -> None:
        """Start nothing yet.

        Args:
          begin: what the process simulates, with the files of its models in this folder.
          python: command of the Python that runs it; empty for this one.
          wake: called when findings are there. Thread: the checker's.
        """
        self._begin = begin
        self._wake = wake
        self._python = shlex.split(python) or [sys.executable]
        self._orders: queue.SimpleQueue[Sequence[Check]] = queue.SimpleQueue()
        self._found: deque[tuple[Check, Finding]] = deque()
        self._thread: threading.Thread | None = None
        self._process: RunnerProcess | None = None
        self._runner: SubprocessRunner | None = None  # once the task is built in the process
        self._closed = threading.Event()
        self._most = 1
        self._busy = False
        self._attempts = _ATTEMPTS
        self.trouble = ""
        """Why it can check nothing, or not some answers; empty if it can."""

    @property
    def pid(self) -> int | None:
        """Id of its process; None if it has not been needed."""
        return None if self._runner is None else self._runner.pid

    @property
    def room(self) -> int:
        """How many checks of one round it takes now; 0 while it works."""
        return 0 if self._busy else self._most

    def give(self, checks: Sequence[Check]) -> None:
        """Let it make these checks, all of one round, when it has room."""
        self._busy = True
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="checker", daemon=True)
            self._thread.start()
        self._orders.put(checks)

    def findings(self) -> list[tuple[Check, Finding]]:
        """What it has found since the last call."""
        findings = [self._found.popleft() for _ in range(len(self._found))]
        self._busy = self._busy and not findings
        return findings

    def close(self) -> None:
        """End the process."""
        self._closed.set()
        self._orders.put(())
        while self._thread is not None and self._thread.is_alive():
            self._end()
            self._thread.join(_LOOK)

    def _serve(self) -> None:
        """Make checks until it is closed. Thread: the checker's."""
        with ExitStack() as stack:
            while not self._closed.is_set():
                checks = self._orders.get()
                if not checks:
                    break
                try:
                    findings: list[Finding] = self._made(checks, stack)
                except Exception as error:  # whatever it is: a round may wait for the findings
                    self.trouble = f"the checker failed ({described(error)})"
                    findings = ["unknown"] * len(checks)
                if not self._closed.is_set():
                    self._found.extend(zip(checks, findings, strict=True))
                    self._wake()
            self._end()

    def _end(self) -> None:
        """End the process, whether the task is built or not."""
        if (process := self._runner or self._process) is not None:
            process.close()

    def _made(self, checks: Sequence[Check], stack: ExitStack) -> list[Finding]:
        """The findings of checks of one round; models' files are there until the stack is closed.
        Thread: the checker's.
        """
        if self._runner is None and self._attempts:
            self._attempts -= 1
            try:
                folder = stack.enter_context(tempfile.TemporaryDirectory())
                begin = self._begin(Path(folder))
                here = Path.cwd()
                self._process = RunnerProcess(here, self._python)
                self._runner = SubprocessRunner(begin, here, self._process, self._python)
            except Exception as error:  # a task may need what only the workers' machines have
                self.trouble = f"the checker cannot simulate the task ({described(error)})"
        if self._runner is None:
            return ["unknown"] * len(checks)
        digest = self._runner.fingerprint
        alike = [each for each in checks if digest.startswith(each.source.fingerprint)]
        if len(alike) < len(checks):
            self.trouble = f"the checker rounds differently (fingerprint {digest[:8]})"
        findings = dict(zip(alike, self._compared(alike), strict=True))
        return [findings.get(each, "unknown") for each in checks]

    def _compared(self, checks: Sequence[Check]) -> list[Finding]:
        """The findings of checks of machines that round as the checker does; of each alone, if a
        job raises an error.
        """
        if not checks:
            return []
        try:
            start = time.monotonic()
            answers = self._answers(checks)
            each = (time.monotonic() - start) / len(checks)
            self._most = int(min(_MOST, max(1.0, _TURN / max(each, 1e-6))))
            return [self._finding(*both) for both in zip(checks, answers, strict=True)]
        except FarmError as error:
            if len(checks) > 1 and not self._closed.is_set():
                return [finding for check in checks for finding in self._compared([check])]
            self.trouble = f"the checker cannot repeat a job ({error})"
            return ["unknown"] * len(checks)

    def _finding(self, check: Check, answer: bytes) -> Finding:
        if answer == check.answer:
            return "right"
        if self._answers([check]) != [answer]:
            self.trouble = (
                "the same rollout has other numbers when it is repeated: farm check TASK shows"
                " where"
            )
            return "unknown"
        return "wrong"

    def _answers(self, checks: Sequence[Check]) -> list[bytes]:
        """The checker's own answers to these jobs of one round; once more if the process dies."""
        assert self._runner is not None
        head = checks[0].header
        jobs = Jobs.joined([check.job for check in checks])
        try:
            results = self._runner.run(head.mu, jobs, "none", head.normaliser, terms=head.terms)
        except FarmError:
            if not self._runner.ended or self._closed.is_set():
                raise
            results = self._runner.run(head.mu, jobs, "none", head.normaliser, terms=head.terms)
        ends = np.cumsum(jobs.rollouts).tolist()
        return [
            bits(results, slice(first, end))
            for first, end in zip([0, *ends[:-1]], ends, strict=True)
        ]
