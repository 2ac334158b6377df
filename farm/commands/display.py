"""How a run is going: one live screen on a terminal, one line a generation elsewhere."""

import logging
import sys
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from learner.learner import Report

_BLOCKS = "▁▂▃▄▅▆▇█"
_SPARK = 30  # fits into 80 columns


class Display(Protocol):
    """Shows reports while it is entered."""

    def __enter__(self) -> "Display":
        """Begin."""
        ...

    def __exit__(self, *_: object) -> None:
        """End."""
        ...

    def show(self, report: Report) -> None:
        """A generation is over."""
        ...


def display(generations: int, done: int) -> Display:
    """A live screen where standard output is a terminal, plain lines elsewhere."""
    console = Console()
    return LiveDisplay(console, generations, done) if console.is_terminal else PlainDisplay(generations)


class PlainDisplay:
    """One line a generation."""

    def __init__(self, generations: int) -> None:
        """Say how many there are to be."""
        self._width = len(str(generations))
        self._generations = generations

    def __enter__(self) -> "PlainDisplay":
        """Nothing to prepare."""
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to put away."""

    def show(self, report: Report) -> None:
        """Write the line."""
        p = report.progress
        sys.stdout.write(
            f"generation {p.generation:>{self._width}}/{self._generations}"
            f"  return {p.return_mean:8.3f}  mean policy {p.mean_policy_return:8.3f}"
            f" {'success' if p.mean_policy_success else '-':7}  success {p.success_rate:4.0%}"
            f"  sigma {p.sigma_mean:6.3f}  {report.rate:5.0f} rollouts/s  {p.workers} workers\n"
        )
        sys.stdout.flush()


class LiveDisplay:
    """Progress bar, returns, sigma and workers, refreshed in place; messages scroll above it."""

    def __init__(self, console: Console, generations: int, done: int) -> None:
        """Prepare the screen for a run that has `done` generations behind it."""
        self._bar = Progress(
            TextColumn("generation"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=console
        )
        self._task = self._bar.add_task("", total=generations, completed=done)
        self._live = Live(self._bar, console=console, refresh_per_second=8)
        self._handler = RichHandler(console=console, show_path=False, show_level=False)
        self._returns: list[float] = []
        self._before: list[logging.Handler] = []

    def __enter__(self) -> "LiveDisplay":
        """Take the terminal; messages are printed above the screen."""
        root = logging.getLogger()
        self._before = [h for h in root.handlers if type(h) is logging.StreamHandler]
        for handler in self._before:
            self._handler.setLevel(handler.level)
            root.removeHandler(handler)
        root.addHandler(self._handler)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the terminal."""
        self._live.stop()
        logging.getLogger().removeHandler(self._handler)
        for handler in self._before:
            logging.getLogger().addHandler(handler)

    def show(self, report: Report) -> None:
        """Refresh."""
        p = report.progress
        self._returns.append(p.mean_policy_return)
        self._bar.update(self._task, completed=p.generation)
        table = Table.grid(padding=(0, 2))
        table.add_row(
            "return", f"{p.return_mean:.3f}", f"[{p.return_min:.3f} .. {p.return_max:.3f}]", f"best {p.best:.3f}"
        )
        succeeded = "[green]success[/green]" if p.mean_policy_success else "no success"
        table.add_row("mean policy", f"{p.mean_policy_return:.3f}", succeeded, _spark(self._returns[-_SPARK:]))
        table.add_row("success", f"{p.success_rate:.0%}", f"dropped {p.dropped}", f"failed {p.failed}")
        table.add_row(
            "sigma", f"{p.sigma_mean:.3f}", f"[{p.sigma_min:.3f} .. {p.sigma_max:.3f}]", f"|mu| {p.mean_norm:.2f}"
        )
        table.add_row("farm", f"{report.rate:.0f} rollouts/s", f"{p.workers} workers", f"re-issued {p.reissued}")
        self._live.update(Group(table, self._bar))


def _spark(values: list[float]) -> str:
    low, high = min(values), max(values)
    span = (high - low) or 1.0
    return "".join(_BLOCKS[int((v - low) / span * (len(_BLOCKS) - 1))] for v in values)
