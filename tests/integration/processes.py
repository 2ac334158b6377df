"""Real processes on loopback: the command `farm` as a person runs it."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SMALL = ("--pairs", "6", "--no-record")
"""A run that is over soon."""


class Farm:
    """Starts `farm` commands and ends them by their process ids."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []

    def start(self, *words: str, host: str | None = None) -> "subprocess.Popen[str]":
        """Start a command, in a network namespace if one is named."""
        return self.start_python("-m", "farm", *words, host=host)

    def start_python(self, *words: str, host: str | None = None) -> "subprocess.Popen[str]":
        where = [] if host is None else ["ip", "netns", "exec", host]
        process = subprocess.Popen(
            [*where, sys.executable, *words],
            cwd=self.folder,
            env={**os.environ, "COLUMNS": "120", "OPENBLAS_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._started.append(process)
        return process

    def call(self, *words: str, status: int = 0, timeout: float = 120) -> str:
        process = self.start(*words)
        said, _ = process.communicate(timeout=timeout)
        assert process.returncode == status, said
        return said

    def summary(self, run: str) -> dict[str, Any]:
        return json.loads((self.folder / "runs" / run / "summary.json").read_text())

    def progress(self, run: str) -> list[dict[str, Any]]:
        path = self.folder / "runs" / run / "progress.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def wait_for(self, event: Callable[[], object], seconds: float = 60) -> None:
        """Look for an event until it is there."""
        until = time.monotonic() + seconds
        while not event():
            assert time.monotonic() < until, "what was waited for did not happen"
            time.sleep(0.02)

    def close(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._started:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout:
                process.stdout.close()


def children(pid: int) -> list[int]:
    """Process ids of a process' children."""
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in path.read_text().split()] if path.exists() else []
