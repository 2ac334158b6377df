"""What commands that do many runs have in common: where these are done, and how they are shown."""

import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from farm import rollouts
from farm.errors import ConfigError
from farm.net import keys
from farm.net.session import check_endpoint
from farm.net.tls import find
from learner.run import check_rerun
from learner.sweep import Sharing, todo


@dataclass(frozen=True, kw_only=True)
class SharingOptions:
    """Where runs side by side are done."""

    parallel: int = 4
    """Learners at a time."""
    workers: int | None = None
    """Local worker processes; None: one a core, with --connect none."""
    backend: str = "cpu"
    """What they simulate with: a name (farm tasks lists them), or FILE.py:CLASS."""
    connect: tuple[str, ...] = ()
    """Use the workers of a farm: its router, repeatable."""
    tls: Path | None = None
    """Folder with the learner's certificates."""
    farm: str = "farm"
    """Name of the farm."""
    record: bool = False
    """Record every run with Rerun."""

    def __post_init__(self) -> None:
        """Check every value."""
        if not 1 <= self.parallel <= 256:
            raise ConfigError(f"parallel is {self.parallel}; expected 1 to 256")
        if self.workers is not None and not 0 <= self.workers <= 1024:
            raise ConfigError(f"workers is {self.workers}; expected 0 to 1024")
        if self.tls is not None and not self.connect:
            raise ConfigError("--tls is for a farm to --connect to: without one everything stays on this machine")
        if self.tls is not None and self.workers:
            raise ConfigError("--workers with --tls: a farm's workers have certificates of their own; see farm worker")
        if self.workers == 0 and not self.connect:
            raise ConfigError("--workers 0 without --connect: nobody would simulate")
        rollouts.backend(self.backend)
        keys.checked("farm", self.farm)
        for endpoint in self.connect:
            check_endpoint(endpoint, encrypted=self.tls is not None)

    def sharing(self) -> Sharing:
        """As runs take it.

        Raises:
          ConfigError: there is no Rerun to record with, or there are no certificates.
        """
        if self.record:
            check_rerun()
        if self.tls is not None:
            find(self.tls, "learner")
        workers = self.workers if self.workers is not None else 0 if self.connect else os.cpu_count() or 1
        return Sharing(
            parallel=self.parallel, workers=workers, backend=self.backend, connect=self.connect, tls=self.tls,
            farm=self.farm, record=self.record,
        )  # fmt: skip


class Runs:
    """Bars on a terminal, a line a run elsewhere."""

    def __init__(self, paths: Iterable[Path], where: Path) -> None:
        """Count what is to be done."""
        paths = list(paths)
        self._left, self._all = len(todo(paths)), len(paths)
        console = Console()
        columns = TextColumn("{task.description}"), BarColumn(None), MofNCompleteColumn(), TimeRemainingColumn()
        self._bars = Progress(*columns, TextColumn("{task.fields[said]}"), console=console, expand=True)
        self._live = console.is_terminal
        self._tasks: dict[str, TaskID] = {}
        self._heard: set[str] = set()
        self._total = self._bars.add_task("runs", total=self._all, completed=self._all - self._left, said="")
        sys.stdout.write(f"{self._left} of {self._all} runs to do, into {where}\n")
        sys.stdout.flush()

    def __enter__(self) -> "Runs":
        """Take the terminal."""
        if self._live:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave it."""
        if self._live:
            self._bars.stop()

    def progress(self, run: str, generation: int, of: int, returned: float) -> None:
        """A generation is over."""
        if run not in self._tasks:
            self._tasks[run] = self._bars.add_task(run, total=of, said="")
        self._bars.update(self._tasks[run], completed=generation, said=f"{returned:8.3f}")

    def said(self, run: str, line: str) -> None:
        """A learner has something to say; the same is said once."""
        if line not in self._heard:
            self._heard.add(line)
            self._print(f"{run}: {line}")

    def ended(self, run: str, state: str, said: str) -> None:
        """A run is over."""
        if run in self._tasks:
            self._bars.remove_task(self._tasks.pop(run))
        if state in ("finished", "diverged"):
            self._left -= 1
        self._bars.update(self._total, completed=self._all - self._left)
        self._print(f"{run} {state}" + (f": {said}" if said else "") + f"  ({self._left} left)")

    def _print(self, line: str) -> None:
        if self._live:
            self._bars.console.print(line, highlight=False, markup=False)
        else:
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
