"""What commands that do many runs have in common: where these are done, and how they are shown."""

import sys
from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from farm.net.tls import find
from learner.run import check_rerun
from learner.sweep import Sharing, todo


def check(sharing: Sharing) -> None:
    """See that there is what the runs need.

    Raises:
      ConfigError: there is no Rerun to record with, or there are no certificates.
    """
    if sharing.record:
        check_rerun()
    if sharing.tls is not None:
        find(sharing.tls, "learner")


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
