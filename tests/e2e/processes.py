"""Real processes on loopback: the command `farm` as users run it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

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
        return self.start_program(*where, sys.executable, *words)

    def start_router(
        self, endpoint: str, *flags: str, zenohd: bool = False
    ) -> "subprocess.Popen[str]":
        """Start a router, `farm router` or a real zenohd with the configuration that it prints; it
        listens.
        """
        if zenohd:
            config = self.folder / f"router-{uuid.uuid4().hex}.json5"
            config.write_text(self.call("router", "--print-config", "--listen", endpoint, *flags))
            process = self.start_program(need_zenohd(), "-c", str(config))
        else:
            process = self.start("router", "--listen", endpoint, *flags)
        assert process.stdout
        assert any("reached at" in line or "router at" in line for line in process.stdout), (
            "it does not listen"
        )
        return process

    def start_program(self, *command: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            command,
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
        output, _ = process.communicate(timeout=timeout)
        assert process.returncode == status, output
        return output

    def summary(self, run: str) -> dict[str, Any]:
        return self.json(f"runs/{run}/summary.json")

    def json(self, path: str) -> dict[str, Any]:
        return json.loads((self.folder / path).read_text())

    def progress(self, run: str) -> list[dict[str, Any]]:
        """A run's generations so far; a line that is still being written does not count."""
        path = self.folder / "runs" / run / "progress.jsonl"
        whole = path.read_text().rpartition("\n")[0] if path.exists() else ""
        return [json.loads(line) for line in whole.splitlines()]

    def wait_for(self, event: Callable[[], object], seconds: float = 60) -> None:
        """Wait until a condition holds."""
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


def need_zenohd() -> str:
    """The program zenohd, as PATH or the variable ZENOHD names it.

    The test is skipped where there is none.
    """
    program = shutil.which(os.environ.get("ZENOHD", "zenohd"))
    if program is None:
        pytest.skip("no zenohd: put it on PATH, or name it in the variable ZENOHD")
    return program


def children(pid: int) -> list[int]:
    """Process ids of a process' children."""
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in path.read_text().split()] if path.exists() else []
