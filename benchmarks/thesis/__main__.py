"""The reproduction of Plage 2016, from a checkout: experiments of many runs each, and their
figures.

python -m benchmarks.thesis NAME ...      runs experiments, then draws their figures
python -m benchmarks.thesis thesis        runs all experiments
python -m benchmarks.thesis --list        lists the experiments
python -m benchmarks.thesis plot FOLDER   redraws the figures from the recorded data
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.thesis import setups
from benchmarks.thesis.catalogue import EXPERIMENTS
from benchmarks.thesis.experiment import judge, verdict
from benchmarks.thesis.folder import ExperimentFolder, find
from farm import command_line
from farm.commands import logs
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, FarmError, RunError
from learner.plots import INSTALL, available
from learner.tools.sweep import runs as sweep
from learner.tools.sweep.command import Runs
from learner.tools.sweep.runs import Sharing
from learner.tools.sweep.sweep import check_sharing

ALL: Final = "thesis"
"""The name for all experiments."""

PROGRAM: Final = "python -m benchmarks.thesis"


@dataclass(frozen=True, kw_only=True)
class ExperimentCommand:
    """Does the runs of experiments side by side, then draws the figures.

    The same command continues after Ctrl-C.

    `plot FOLDER` instead of a name redraws the figures of such a folder from its recorded data.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names of experiments (see --list); thesis means all."""
    list: bool = False
    """List the experiments, and exit."""
    trials: int | None = None
    """Runs of each set-up, with seeds 0, 1, ...; None: those of the experiment, as in the results.
    """
    generations: int | None = None
    """Shorten every run to this number of generations."""
    out: Path | None = None
    """Folder for runs, data and figures; None: runs/NAME."""
    sharing: Sharing = field(default_factory=Sharing)
    """Workers of the runs."""

    def __post_init__(self) -> None:
        """Check every value."""
        if self.trials is not None and not 1 <= self.trials <= 1000:
            raise ConfigError(f"trials is {self.trials}; expected 1 to 1000")
        if self.generations is not None and not 1 <= self.generations <= 10_000_000:
            raise ConfigError(f"generations is {self.generations}; expected 1 to 10000000")


@dataclass(frozen=True, kw_only=True)
class PlotCommand:
    """Redraws the figures of an experiment from its recorded data, as PNG and SVG."""

    folder: tyro.conf.Positional[Path]
    """Folder of an experiment."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    if words and words[0] == "plot":
        return _plot(words[1:])
    command = command_line.parse(ExperimentCommand, words, PROGRAM)
    if command.list:
        _list()
        return 0
    if not command.names:
        raise ConfigError(f"which experiment? {PROGRAM} --list shows them")
    selection = {
        name
        for each in command.names
        for name in (EXPERIMENTS if each == ALL else (find(each).name,))
    }
    names = tuple(name for name in EXPERIMENTS if name in selection)
    check_matplotlib()
    check_sharing(command.sharing)
    logs.set_up("WARNING")
    out = command.out or Path("runs") / "+".join(command.names)
    folder = ExperimentFolder.prepare(out, names, command.trials, command.generations)
    with stop_flag("saving and ending") as stop:
        with Runs(folder.runs, folder.path) as display:
            complete = sweep.run(folder.runs, command.sharing, display, stop.is_set)
        folder.gather()
        if stop.is_set():
            sys.stdout.write(
                f"{len(sweep.todo(folder.runs))} runs are left; the same command continues\n"
            )
            return INTERRUPTED
    draw(folder)
    return 0 if complete else 1


def _plot(words: Sequence[str]) -> int:
    command = command_line.parse(PlotCommand, words, f"{PROGRAM} plot")
    check_matplotlib()
    folder = ExperimentFolder.open(command.folder)
    folder.gather()
    draw(folder)
    return 0


def check_matplotlib() -> None:
    """Check that matplotlib, an optional package, is installed.

    Raises:
      ConfigError: it is not; the message says what to install.
    """
    if not available():
        raise ConfigError(INSTALL)


def draw(folder: ExperimentFolder) -> None:
    """Measure what is missing, draw every figure, and print the findings."""
    for name in folder.experiments:
        _draw(folder, name)
    sys.stdout.flush()


def _draw(folder: ExperimentFolder, name: str) -> None:
    """One experiment's figure and findings.

    Raises:
      RunError: the figure cannot be written.
    """
    from benchmarks.thesis.figures import draw as drawn
    from benchmarks.thesis.measure import measure

    experiment = EXPERIMENTS[name]
    if experiment.curves and all(
        series.empty for series in folder.data(experiment).series.values()
    ):
        sys.stdout.write(f"{name}: none of its runs has started\n")
        return
    measure(folder, experiment)
    data = folder.data(experiment)
    try:
        paths = drawn(experiment, data, folder.path)
    except OSError as error:
        raise RunError(f"cannot write the figure of {name}: {error.strerror}") from None
    lines = [f"{name}: {' and '.join(map(str, paths))}"]
    lines += [
        f"  {label}: {failure}"
        for label, series in data.series.items()
        for failure in series.failures()
    ]
    findings = judge(experiment, data)
    lines += [f"  {finding.answer:<3}  {finding.part}: {finding.numbers}" for finding in findings]
    if folder.generations is not None:
        lines.append(
            f"  runs shortened to {folder.generations} generations say little about the claim"
        )
    elif experiment.claim and findings:
        lines.append(f"  {verdict(findings)}")
    sys.stdout.write("\n".join(lines) + "\n")


def _list() -> None:
    table = Table()
    for column in ("experiment", "question", "runs", "rollouts", "minutes"):
        table.add_column(
            column, justify="left" if column in ("experiment", "question") else "right"
        )
    for name in EXPERIMENTS:
        table.add_row(name, EXPERIMENTS[name].question, *_cost((name,)))
    every = "all experiments; a run that several of them share is done once"
    table.add_row(ALL, every, *_cost(tuple(EXPERIMENTS)))
    Console().print(table)
    sys.stdout.write(
        "Runs, rollouts and minutes on two cores (--trials changes the number of runs)\n"
    )


def _cost(names: tuple[str, ...]) -> tuple[str, str, str]:
    """Runs, rollouts and minutes of experiments."""
    folder = ExperimentFolder(path=Path(), experiments=names, trials=None, generations=None)
    counts = {setup: folder.count(setup) for setup in folder.setups}
    rollouts = sum(count * setups.rollouts(setup) for setup, count in counts.items())
    minutes = sum(count * setups.minutes((setup,)) for setup, count in counts.items())
    return str(sum(counts.values())), str(rollouts), f"{minutes:.0f}"


def _exit(words: Sequence[str]) -> int:
    """Run the command; return its exit status. Errors are printed as one line."""
    try:
        return main(words)
    except KeyboardInterrupt:
        return INTERRUPTED
    except FarmError as error:
        sys.stderr.write(f"benchmarks.thesis: {error}\n")
        return 2 if isinstance(error, ConfigError) else 1


if __name__ == "__main__":
    sys.exit(_exit(sys.argv[1:]))
