"""Runs side by side: several learners share one set of workers, so that a pool of any size is kept busy.

A generation of 15 pairs cannot keep many workers busy, four learners' generations can. Each learner is a process
of its own, `farm learner` as a person would start it, at one router; their numbers are those of runs one after
another, because a run's numbers depend on nobody else.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Protocol

from benchmarks.thesis.folder import ExperimentFolder
from farm.errors import RunError
from farm.net import session
from farm.net.session import free_endpoint
from farm.processes import Pool
from learner import config as configs
from learner.run_folder import RunFolder

log = logging.getLogger(__name__)

_LOOK: Final = 0.1  # [s] between two looks at the learners
_GRACE: Final = 20.0  # [s] that learners have to save and leave


@dataclass(frozen=True, kw_only=True)
class Sharing:
    """Where experiments run; no number depends on it."""

    parallel: int = 4
    """Learners at a time."""
    workers: int = 2
    """Local worker processes."""
    connect: tuple[str, ...] = ()
    """Routers of a farm to dial, instead of one of our own."""
    tls: Path | None = None
    """Folder with the learner's certificates."""
    farm: str = "farm"
    """Name of the farm."""
    record: bool = False
    """Record every run with Rerun."""


class Shown(Protocol):
    """Told how the runs are doing."""

    def progress(self, run: str, generation: int, of: int, returned: float) -> None:
        """A generation is over."""
        ...

    def said(self, run: str, line: str) -> None:
        """A learner has something to say: that nobody answers, that there are no workers."""
        ...

    def ended(self, run: str, state: str, said: str) -> None:
        """A run is over: finished, diverged, failed or interrupted; `said` is its reason, or how well it did."""
        ...


@dataclass
class _Learner:
    """A learner's process, and what it said last."""

    run: str
    path: Path
    process: "subprocess.Popen[str]"
    reader: threading.Thread = field(init=False)
    said: deque[str] = field(default_factory=lambda: deque(maxlen=5))


def run(folder: ExperimentFolder, sharing: Sharing, shown: Shown, stopped: Callable[[], bool]) -> bool:
    """Do the runs of an experiment that are not over.

    Returns:
      whether all are over now; not, if it was stopped or runs failed.

    Raises:
      RunError: no local worker keeps running.
    """
    todo = deque(folder.todo())
    if not todo:
        return True
    with ExitStack() as stack:
        endpoints, pool = sharing.connect, None
        if not endpoints:
            endpoints = (free_endpoint(),)
            stack.enter_context(session.listen(endpoints[0], sharing.farm, None))
        flags = [word for endpoint in endpoints for word in ("--connect", endpoint)]
        flags += ["--farm", sharing.farm, *(["--tls", str(sharing.tls)] if sharing.tls else [])]
        if sharing.workers:
            pool = stack.enter_context(Pool(sharing.workers, [*flags, "--log-level", "ERROR"], dict(os.environ)))
        plans = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        running: list[_Learner] = []
        stack.callback(_end, running)
        while (todo or running) and not stopped():
            while todo and len(running) < sharing.parallel:
                running.append(_start(folder, *todo.popleft(), plans, [*flags, *_RECORD[sharing.record]], shown))
            for learner in [one for one in running if one.process.poll() is not None]:
                running.remove(learner)
                _conclude(learner, shown)
            if pool and pool.tend() and not pool.pids:
                raise RunError("no local worker keeps running; their own messages above say why")
            time.sleep(_LOOK)
        _end(running)
        for learner in running:
            _conclude(learner, shown)
        running.clear()
    return not folder.todo()


_RECORD: Final = {True: ("--record",), False: ("--no-record",)}


def _start(
    folder: ExperimentFolder, setup: str, number: int, plans: Path, flags: Sequence[str], shown: Shown
) -> _Learner:
    target = folder.run(setup, number)
    plan = plans / f"{target.name}.json"
    plan.write_text(json.dumps(configs.to_dict(folder.config(setup, number))), "utf-8")
    command = [
        sys.executable, "-m", "learner.sweep", "--config", str(plan), "--out", str(target.path.parent),
        "--name", target.name, "--resume-existing", "--json", "--log-level", "WARNING", *flags,
    ]  # fmt: skip
    # Standard input is a pipe that nobody writes to: it closes when this process ends, however it ends.
    # A session of its own keeps the terminal's Ctrl-C away: this process ends its learners.
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "utf-8"},
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    learner = _Learner(target.name, target.path, process)
    learner.reader = threading.Thread(target=_listen, args=(learner, shown), daemon=True)
    learner.reader.start()
    return learner


def _listen(learner: _Learner, shown: Shown) -> None:
    """Pass on what a learner says; a thread that ended would leave it stuck at a full pipe."""
    assert learner.process.stdout
    generations = 0
    for line in learner.process.stdout:
        told = _event(line)
        if told is None:
            learner.said.append(line.strip())
            shown.said(learner.run, line.strip())
        elif told["event"] == "run":
            generations = told["config"]["generations"]
        elif told["event"] == "generation":
            shown.progress(learner.run, told["generation"], generations, told["mean_policy_return"])


def _event(line: str) -> dict[str, Any] | None:
    """A line of --json; None for any other."""
    try:
        told = json.loads(line)
    except ValueError:
        return None
    return told if isinstance(told, dict) and "event" in told else None


def _conclude(learner: _Learner, shown: Shown) -> None:
    """Say how a learner's run ended."""
    learner.reader.join()
    summary, status = RunFolder(learner.path).read_summary() or {}, learner.process.returncode
    stopped = status in (130, -signal.SIGTERM)
    state = summary.get("state", "interrupted" if stopped else "failed")
    if status != 0 and not stopped and state != "diverged":
        state = "failed"
    said = " ".join(learner.said)
    if state == "finished":
        success = "succeeds" if summary["mean_policy_success"] else "does not succeed"
        said = f"mean policy returns {summary['mean_policy_return']:.3f} and {success}"
    shown.ended(learner.run, state, said)


def _end(learners: list[_Learner]) -> None:
    """Have them save and leave; who has not in time is killed."""
    for learner in learners:
        learner.process.terminate()
    until = time.monotonic() + _GRACE
    for learner in learners:
        try:
            learner.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            learner.process.kill()
            learner.process.wait()


def _learn(words: Sequence[str]) -> int:
    """`farm learner`, ended as by SIGTERM when whoever started it is gone."""
    from farm.__main__ import main

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    return main(["learner", *words])


if __name__ == "__main__":
    sys.exit(_learn(sys.argv[1:]))
