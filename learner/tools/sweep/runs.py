"""Simultaneous runs: several learners share one set of workers, so that a pool of any size is kept
busy.

A generation of 15 pairs cannot keep many workers busy, but the generations of four learners can.
Each learner is a separate process, `farm learner`, and all are connected to one router. Their
numbers are those of runs one after another, because a run's numbers depend on no other run.

`run` takes run folders and their configurations, from any source: settings x seeds
(`learner.tools.sweep.grid`), or an experiment. Finished runs are not repeated; other runs continue
from their checkpoints.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from farm import plugins
from farm.commands.screen import figure
from farm.errors import ConfigError, RunError
from farm.link import Link
from farm.net import session
from farm.net.session import free_endpoint
from farm.processes import LocalWorkers, cores, end
from farm.runner import make_backend
from farm.settings import setting
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

log = logging.getLogger(__name__)

_LOOK: Final = 0.1  # [s] between two checks of the learners
_GRACE: Final = 20.0  # [s] for learners to save and leave


class RunWatcher(Protocol):
    """Receiver of the runs' progress. Thread: readers, several; main for `ended`."""

    def progress(self, run: str, generation: int, of: int, returned: float | None) -> None:
        """A generation has ended, with this return of the mean policy; None if that failed."""

    def said(self, run: str, line: str) -> None:
        """A learner has written a line."""

    def ended(self, run: str, state: str, detail: str) -> None:
        """A run is finished, diverged, failed or interrupted; `detail` is its reason or its
        result.
        """


class Logged:
    """Writes to the log how the runs go."""

    def progress(self, run: str, generation: int, of: int, returned: float | None) -> None:
        """Log the end of a generation, for debugging only."""
        value = figure(returned, ".6g")
        log.debug("%s: generation %d of %d, return %s", run, generation, of, value)

    def said(self, run: str, line: str) -> None:
        """Log a learner's line as a warning: learners write nothing else."""
        log.warning("%s: %s", run, line)

    def ended(self, run: str, state: str, detail: str) -> None:
        """Log the end of a run, as a warning unless it is finished."""
        level = logging.INFO if state == "finished" else logging.WARNING
        log.log(level, "%s %s: %s", run, state, detail)


@dataclass(frozen=True, kw_only=True)
class Sharing(Link):
    """Placement of simultaneous runs; does not affect their numbers."""

    parallel: int = setting(4, least=1, most=256)
    """Number of simultaneous learners."""
    workers: int | None = setting(None, least=0, most=1024)
    """Local worker processes; by default one per core, with --connect none."""
    backend: str = "cpu"
    """Simulation backend of these workers: a name (farm tasks lists them), or FILE.py:CLASS."""
    record: bool = False
    """Record every run with Rerun."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tls is not None and not self.connect:
            raise ConfigError(
                "--tls is for a farm to --connect to: without one everything stays on this machine"
            )
        if self.tls is not None and self.workers:
            raise ConfigError(
                "--workers with --tls: a farm's workers have certificates of their own; see farm"
                " worker"
            )
        if self.workers == 0 and not self.connect:
            raise ConfigError("--workers 0 without --connect: there would be no workers")
        make_backend(self.backend)

    @property
    def processes(self) -> int:
        """Local worker processes."""
        return self.workers if self.workers is not None else 0 if self.connect else cores()


@dataclass
class _Learner:
    """A learner's process, and its last message."""

    path: Path
    process: "subprocess.Popen[str]"
    reader: threading.Thread = field(init=False)
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=5))

    @property
    def run(self) -> str:
        """The run's name."""
        return self.path.name


def todo(runs: Mapping[Path, RunConfig]) -> list[Path]:
    """The folders whose runs are not over, in the same order; a finished run may have been given
    more generations.
    """
    return [path for path, config in runs.items() if not _over(path, config)]


def _over(path: Path, config: RunConfig) -> bool:
    """Whether a run has ended: diverged, or finished as its configuration says."""
    folder = RunFolder(path)
    summary = folder.read_summary() or {}
    if summary.get("state") != "finished":
        return summary.get("state") == "diverged"
    # A run that stopped early, when it was solved, has fewer generations than it was allowed.
    return (
        summary.get("generations", 0) >= config.generations
        or folder.read_config().generations >= config.generations
    )


@dataclass
class Site:
    """A router and local workers that several learners share."""

    flags: Sequence[str]
    """Flags with which a learner connects."""
    workers: LocalWorkers | None
    """The local workers."""
    parallel: int
    """Number of simultaneous learners."""

    def run(
        self,
        runs: Mapping[Path, RunConfig],
        watcher: RunWatcher,
        stopped: Callable[[], bool],
        *,
        record: bool = False,
    ) -> bool:
        """Do the runs that are not over, in order, each in its folder; return whether all are over
        then.

        Raises:
          RunError: no local worker keeps running.
        """
        waiting = deque(todo(runs))
        flags = [*self.flags, "--record" if record else "--no-record"]
        with ExitStack() as stack:
            plans = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            running: list[_Learner] = []
            stack.callback(lambda: end([learner.process for learner in running], _GRACE))
            while (waiting or running) and not stopped():
                while waiting and len(running) < self.parallel:
                    path = waiting.popleft()
                    running.append(_start(path, runs[path], plans, flags, watcher))
                for learner in [one for one in running if one.process.poll() is not None]:
                    running.remove(learner)
                    _conclude(learner, watcher)
                if self.workers and self.workers.tend() and not self.workers.pids:
                    raise RunError("no local worker keeps running; see their messages above")
                time.sleep(_LOOK)
            end([learner.process for learner in running], _GRACE)
            for learner in running:
                _conclude(learner, watcher)
            running.clear()
        return not todo(runs)


@contextmanager
def site(sharing: Sharing, runs: Iterable[RunConfig]) -> Iterator[Site]:
    """Start the router and the local workers, which may serve the files of these runs."""
    with ExitStack() as stack:
        flags = _router(sharing, stack)
        yield Site(flags, _workers(sharing, flags, runs, stack), sharing.parallel)


def run(
    runs: Mapping[Path, RunConfig],
    sharing: Sharing,
    watcher: RunWatcher,
    stopped: Callable[[], bool],
) -> bool:
    """Do the runs that are not over on a site of their own; return whether all are over then.

    See `Site.run`.
    """
    if not todo(runs):
        return True
    with site(sharing, runs.values()) as place:
        return place.run(runs, watcher, stopped, record=sharing.record)


def _router(sharing: Sharing, stack: ExitStack) -> list[str]:
    """Flags that connect learners and workers; without a given router one is started."""
    endpoints = sharing.connect
    if not endpoints:
        endpoints = (free_endpoint(),)
        stack.enter_context(session.listen(endpoints[0], sharing.farm, None))
    flags = [word for endpoint in endpoints for word in ("--connect", endpoint)]
    return [*flags, "--farm", sharing.farm, *(["--tls", str(sharing.tls)] if sharing.tls else [])]


def _workers(
    sharing: Sharing, flags: Sequence[str], runs: Iterable[RunConfig], stack: ExitStack
) -> LocalWorkers | None:
    """Local workers, which may serve the files of these runs."""
    if not sharing.processes:
        return None
    parts = {("tasks", config.task) for config in runs} | {
        ("policies", config.policy) for config in runs
    }
    files = sorted({str(file) for kind, name in parts if (file := plugins.find(kind, name).file)})
    options = [*flags, "--backend", sharing.backend, "--log-level", "ERROR"]
    options += [word for file in files for word in ("--allow-file", file)]
    return stack.enter_context(LocalWorkers(sharing.processes, options))


def _start(
    path: Path, config: RunConfig, plans: Path, flags: Sequence[str], watcher: RunWatcher
) -> _Learner:
    plan = plans / f"{path.name}.json"
    plan.write_text(json.dumps(configs.to_dict(config)), "utf-8")
    command = [
        sys.executable,
        "-P",
        "-m",
        "learner.tools.sweep.runs",
        "--config",
        str(plan),
        "--out",
        str(path.parent),
        "--name",
        path.name,
        "--resume-existing",
        "--json",
        "--log-level",
        "WARNING",
        "--no-compare",
        *flags,
    ]
    # Standard input is a pipe that is never written to: it closes when this process ends, however
    # it ends. In a separate session, which Ctrl-C on the terminal does not reach: this process ends
    # its learners.
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        env={
            **os.environ,
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
            "PYTHONIOENCODING": "utf-8",
        },
        encoding="utf-8",
        errors="replace",
    )
    learner = _Learner(path, process)
    learner.reader = threading.Thread(target=_listen, args=(learner, watcher), daemon=True)
    learner.reader.start()
    return learner


def _listen(learner: _Learner, watcher: RunWatcher) -> None:
    """Forward a learner's output; if this thread ended, the learner would block on a full pipe.

    Thread: reader.
    """
    assert learner.process.stdout
    generations = 0
    for line in learner.process.stdout:
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict) or "event" not in message:
            learner.messages.append(line.strip())
            watcher.said(learner.run, line.strip())
        elif message["event"] == "run":
            generations = message["config"]["generations"]
        elif message["event"] == "generation":
            watcher.progress(
                learner.run, message["generation"], generations, message["mean_policy_return"]
            )


def _conclude(learner: _Learner, watcher: RunWatcher) -> None:
    learner.reader.join()
    for pipe in (learner.process.stdin, learner.process.stdout):
        assert pipe
        pipe.close()
    summary, status = RunFolder(learner.path).read_summary() or {}, learner.process.returncode
    stopped = status in (130, -signal.SIGTERM)
    state = summary.get("state", "interrupted" if stopped else "failed")
    if status != 0 and not stopped and state != "diverged":
        state = "failed"
    detail = "" if state == "interrupted" else " ".join(learner.messages)
    if state == "finished":
        judged = {True: " and succeeds", False: " and does not succeed", None: ""}[
            summary["mean_policy_success"]
        ]
        value = summary["mean_policy_return"]
        detail = (
            "mean policy fails" if value is None else f"mean policy returns {value:.3f}{judged}"
        )
    watcher.ended(learner.run, state, detail)


def _learn(words: Sequence[str]) -> int:
    """`farm learner`, which ends as after SIGTERM when the process that started it is gone."""
    from farm.__main__ import main

    def watch() -> None:
        """Thread: helper."""
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    return main(["learner", *words])


if __name__ == "__main__":
    sys.exit(_learn(sys.argv[1:]))
