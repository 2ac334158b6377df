"""`farm experiment`: runs of an experiment side by side, and its figure."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from benchmarks.thesis import catalogue, plot
from benchmarks.thesis.catalogue import EXPERIMENTS, TRIALS
from benchmarks.thesis.folder import ExperimentFolder, find
from farm import settings as arguments
from farm.commands import logs
from farm.commands.signals import stop_flag
from farm.errors import ConfigError
from farm.net import keys
from farm.net.session import check_endpoint
from farm.net.tls import find as find_bundle
from learner.run import check_rerun
from learner.sweep import Sharing, run

ALL = "thesis"
"""All experiments."""


@dataclass(frozen=True, kw_only=True)
class ExperimentCommand:
    """An experiment's runs side by side, then its figure; given again, it goes on where it stopped."""

    name: Annotated[str, tyro.conf.Positional] = ""
    """One of --list, or thesis for all."""
    list: bool = False
    """List the experiments, and end."""
    trials: int = TRIALS
    """Runs of each set-up, with seeds 0, 1, ..."""
    generations: int | None = None
    """Make every run this short."""
    out: Path | None = None
    """Folder for runs, data and figures; None: runs/NAME."""
    parallel: int = 4
    """Learners at a time."""
    workers: int | None = None
    """Local worker processes; None: one a core, with --connect none."""
    connect: tuple[str, ...] = ()
    """Use the workers of a farm: dial its router, repeatable."""
    tls: Path | None = None
    """Folder with the learner's certificates."""
    farm: str = "farm"
    """Name of the farm."""
    record: bool = False
    """Record every run with Rerun."""

    def __post_init__(self) -> None:
        """Check every value."""
        for what, value, most in (("trials", self.trials, 1000), ("parallel", self.parallel, 256)):
            if not 1 <= value <= most:
                raise ConfigError(f"{what} is {value}; expected 1 to {most}")
        if self.generations is not None and not 1 <= self.generations <= 10_000_000:
            raise ConfigError(f"generations is {self.generations}; expected 1 to 10000000")
        if self.workers is not None and not 0 <= self.workers <= 1024:
            raise ConfigError(f"workers is {self.workers}; expected 0 to 1024")
        if self.tls is not None and not self.connect:
            raise ConfigError("--tls is for a farm to --connect to: without one everything stays on this machine")
        if self.tls is not None and self.workers:
            raise ConfigError(
                "--workers with --tls: a farm's workers have certificates of their own; start farm worker"
            )
        if self.workers == 0 and not self.connect:
            raise ConfigError("--workers 0 without --connect: nobody would simulate")
        keys.checked("farm", self.farm)
        for endpoint in self.connect:
            check_endpoint(endpoint, encrypted=self.tls is not None)


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ExperimentCommand, words, "farm experiment")
    if command.list:
        _list()
        return 0
    if not command.name:
        raise ConfigError("which experiment? farm experiment --list shows them")
    names = tuple(EXPERIMENTS) if command.name == ALL else (find(command.name).name,)
    plot.check_matplotlib()
    if command.record:
        check_rerun()
    if command.tls is not None:
        find_bundle(command.tls, "learner")
    logs.set_up("WARNING")
    out = command.out or Path("runs") / command.name
    folder = ExperimentFolder.prepare(out, names, command.trials, command.generations)
    workers = command.workers if command.workers is not None else 0 if command.connect else os.cpu_count() or 1
    sharing = Sharing(
        parallel=command.parallel, workers=workers, connect=command.connect, tls=command.tls, farm=command.farm,
        record=command.record,
    )  # fmt: skip
    with stop_flag("saving and ending") as stop:
        with Runs(folder) as shown:
            complete = run(folder, sharing, shown, stop.is_set)
        folder.gather()
        if stop.is_set():
            sys.stdout.write(f"{len(folder.todo())} runs are left; the same command goes on with them\n")
            return 130
    plot.draw(folder)
    return 0 if complete else 1


def _list() -> None:
    table = Table()
    for column in ("experiment", "question", "runs", "rollouts", "minutes"):
        table.add_column(column, justify="left" if column in ("experiment", "question") else "right")
    for name, experiment in EXPERIMENTS.items():
        setups = tuple(experiment.curves.values())
        rollouts = sum(map(catalogue.rollouts, setups))
        table.add_row(
            name, experiment.question, str(TRIALS * len(setups)), str(TRIALS * rollouts),
            f"{TRIALS * catalogue.minutes(setups):.0f}",
        )  # fmt: skip
    every = tuple(dict.fromkeys(s for e in EXPERIMENTS.values() for s in e.curves.values()))
    total = sum(map(catalogue.rollouts, every))
    minutes = f"{TRIALS * catalogue.minutes(every):.0f}"
    table.add_row(
        ALL, "all of them; runs that several show are done once", str(TRIALS * len(every)), str(TRIALS * total), minutes
    )
    Console().print(table)
    sys.stdout.write(f"runs, rollouts and minutes on two cores are of {TRIALS} trials; --trials changes it\n")


class Runs:
    """Bars on a terminal, a line a run elsewhere."""

    def __init__(self, folder: ExperimentFolder) -> None:
        """Count what is to be done."""
        self._left = len(folder.todo())
        self._all = folder.trials * len(folder.setups)
        console = Console()
        columns = TextColumn("{task.description}"), BarColumn(None), MofNCompleteColumn(), TimeRemainingColumn()
        self._bars = Progress(*columns, TextColumn("{task.fields[said]}"), console=console, expand=True)
        self._live = console.is_terminal
        self._tasks: dict[str, TaskID] = {}
        self._heard: set[str] = set()
        self._total = self._bars.add_task("runs", total=self._all, completed=self._all - self._left, said="")
        sys.stdout.write(f"{self._left} of {self._all} runs to do, into {folder.path}\n")
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
