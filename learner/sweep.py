"""Simultaneous runs: several learners share one set of workers, so that a pool of any size is kept busy.

A generation of 15 pairs cannot keep many workers busy, but the generations of four learners can. Each learner is a
separate process, `farm learner`, and all are connected to one router. Their numbers are those of runs one after
another, because a run's numbers depend on no other run.

`run` takes run folders and their configurations, from any source: settings x seeds (`learner.grid`), or an
experiment. Finished runs are not repeated; other runs continue from their checkpoints.
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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from farm import plugins, rollouts
from farm.errors import ConfigError, RunError
from farm.net import keys, session
from farm.net.session import check_endpoint, free_endpoint
from farm.processes import Pool, end
from farm.settings import Settings, setting
from learner import config as configs
from learner.config import RunConfig
from learner.run_folder import RunFolder

if TYPE_CHECKING:
    from learner.commands.sweep import Runs

log = logging.getLogger(__name__)

_LOOK: Final = 0.1  # [s] between two checks of the learners
_GRACE: Final = 20.0  # [s] for learners to save and leave
_OVER: Final = ("finished", "diverged")  # states that another run would not change


@dataclass(frozen=True, kw_only=True)
class Sharing(Settings):
    """Placement of simultaneous runs; does not affect their numbers."""

    parallel: int = setting(4, least=1, most=256)
    """Number of simultaneous learners."""
    workers: int | None = setting(None, least=0, most=1024)
    """Local worker processes; by default one per core, with --connect none."""
    backend: str = "cpu"
    """Simulation backend of these workers: a name (farm tasks lists them), or FILE.py:CLASS."""
    connect: tuple[str, ...] = ()
    """Use the workers of a farm: its router, repeatable."""
    tls: Path | None = None
    """Folder with the learner's certificates."""
    farm: str = "farm"
    """Name of the farm."""
    record: bool = False
    """Record every run with Rerun."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tls is not None and not self.connect:
            raise ConfigError("--tls is for a farm to --connect to: without one everything stays on this machine")
        if self.tls is not None and self.workers:
            raise ConfigError("--workers with --tls: a farm's workers have certificates of their own; see farm worker")
        if self.workers == 0 and not self.connect:
            raise ConfigError("--workers 0 without --connect: there would be no workers")
        rollouts.backend(self.backend)
        keys.checked("farm", self.farm)
        for endpoint in self.connect:
            check_endpoint(endpoint, encrypted=self.tls is not None)

    @property
    def processes(self) -> int:
        """Local worker processes."""
        return self.workers if self.workers is not None else 0 if self.connect else os.cpu_count() or 1


@dataclass
class _Learner:
    """A learner's process, and its last message."""

    path: Path
    process: "subprocess.Popen[str]"
    reader: threading.Thread = field(init=False)
    said: deque[str] = field(default_factory=lambda: deque(maxlen=5))

    @property
    def run(self) -> str:
        """The run's name."""
        return self.path.name


def todo(runs: Iterable[Path]) -> list[Path]:
    """The run folders whose runs are not over, in the same order."""
    return [path for path in runs if (RunFolder(path).read_summary() or {}).get("state") not in _OVER]


def run(runs: Mapping[Path, RunConfig], sharing: Sharing, shown: "Runs", stopped: Callable[[], bool]) -> bool:
    """Do the runs that are not over, in order, each in its folder; return whether all are over then.

    Raises:
      RunError: no local worker keeps running.
    """
    waiting = deque(todo(runs))
    if not waiting:
        return True
    with ExitStack() as stack:
        flags = _router(sharing, stack)
        pool = _workers(sharing, flags, runs.values(), stack)
        flags += ["--record" if sharing.record else "--no-record"]
        plans = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        running: list[_Learner] = []
        stack.callback(lambda: end([learner.process for learner in running], _GRACE))
        while (waiting or running) and not stopped():
            while waiting and len(running) < sharing.parallel:
                path = waiting.popleft()
                running.append(_start(path, runs[path], plans, flags, shown))
            for learner in [one for one in running if one.process.poll() is not None]:
                running.remove(learner)
                _conclude(learner, shown)
            if pool and pool.tend() and not pool.pids:
                raise RunError("no local worker keeps running; see their messages above")
            time.sleep(_LOOK)
        end([learner.process for learner in running], _GRACE)
        for learner in running:
            _conclude(learner, shown)
        running.clear()
    return not todo(runs)


def _router(sharing: Sharing, stack: ExitStack) -> list[str]:
    """Flags that connect learners and workers; without a given router one is started."""
    endpoints = sharing.connect
    if not endpoints:
        endpoints = (free_endpoint(),)
        stack.enter_context(session.listen(endpoints[0], sharing.farm, None))
    flags = [word for endpoint in endpoints for word in ("--connect", endpoint)]
    return [*flags, "--farm", sharing.farm, *(["--tls", str(sharing.tls)] if sharing.tls else [])]


def _workers(sharing: Sharing, flags: Sequence[str], runs: Iterable[RunConfig], stack: ExitStack) -> Pool | None:
    """Local workers, which may serve the files of these runs."""
    if not sharing.processes:
        return None
    chosen = {("tasks", config.task) for config in runs} | {("policies", config.policy) for config in runs}
    files = sorted({str(file) for kind, name in chosen if (file := plugins.find(kind, name).file)})
    own = [*flags, "--backend", sharing.backend, "--log-level", "ERROR"]
    own += [word for file in files for word in ("--allow-file", file)]
    return stack.enter_context(Pool(sharing.processes, own, dict(os.environ)))


def _start(path: Path, config: RunConfig, plans: Path, flags: Sequence[str], shown: "Runs") -> _Learner:
    plan = plans / f"{path.name}.json"
    plan.write_text(json.dumps(configs.to_dict(config)), "utf-8")
    command = [
        sys.executable, "-P", "-m", "learner.sweep", "--config", str(plan), "--out", str(path.parent),
        "--name", path.name, "--resume-existing", "--json", "--log-level", "WARNING", *flags,
    ]  # fmt: skip
    # Standard input is a pipe that is never written to: it closes when this process ends, however it ends.
    # In a separate session, which Ctrl-C on the terminal does not reach: this process ends its learners.
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "utf-8"},
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    learner = _Learner(path, process)
    learner.reader = threading.Thread(target=_listen, args=(learner, shown), daemon=True)
    learner.reader.start()
    return learner


def _listen(learner: _Learner, shown: "Runs") -> None:
    """Forward a learner's output; if this thread ended, the learner would block on a full pipe."""
    assert learner.process.stdout
    generations = 0
    for line in learner.process.stdout:
        try:
            told = json.loads(line)
        except ValueError:
            told = None
        if not isinstance(told, dict) or "event" not in told:
            learner.said.append(line.strip())
            shown.said(learner.run, line.strip())
        elif told["event"] == "run":
            generations = told["config"]["generations"]
        elif told["event"] == "generation":
            shown.progress(learner.run, told["generation"], generations, told["mean_policy_return"])


def _conclude(learner: _Learner, shown: "Runs") -> None:
    learner.reader.join()
    summary, status = RunFolder(learner.path).read_summary() or {}, learner.process.returncode
    stopped = status in (130, -signal.SIGTERM)
    state = summary.get("state", "interrupted" if stopped else "failed")
    if status != 0 and not stopped and state != "diverged":
        state = "failed"
    said = " ".join(learner.said)
    if state == "finished":
        judged = {True: " and succeeds", False: " and does not succeed", None: ""}[summary["mean_policy_success"]]
        said = f"mean policy returns {summary['mean_policy_return']:.3f}{judged}"
    shown.ended(learner.run, state, said)


def _learn(words: Sequence[str]) -> int:
    """`farm learner`, which ends as after SIGTERM when the process that started it is gone."""
    from farm.__main__ import main

    def watch() -> None:
        while os.read(0, 1024):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
    return main(["learner", *words])


if __name__ == "__main__":
    sys.exit(_learn(sys.argv[1:]))
