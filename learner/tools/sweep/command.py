"""`farm sweep`: settings x seeds on one set of workers; a table and a figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from farm.commands import logs, screen
from farm.commands.logs import say
from farm.commands.screen import Console, compact, plain, wide
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, writing
from farm.near import meant
from farm.settings import Settings
from learner import parquet, plots
from learner.commands.options import USUAL, flag, parse
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.tools.sweep import figure, grid, outcomes
from learner.tools.sweep import runs as sweeps
from learner.tools.sweep.grid import Setting, Sweep
from learner.tools.sweep.sweep import learnt, prepare

_USUAL: Final = tuple(name for name in USUAL if name != "seed")
"""Settings that `farm sweep --help` shows: it has --seeds."""


@dataclass(frozen=True, kw_only=True)
class SweepCommand(Settings):
    """Learns settings x seeds on one set of workers; makes table and figure.

    Run it again to continue.
    """

    vary: tuple[str, ...] = ()
    """NAME=V1,V2,...: a setting and its values, repeatable; every combination is learnt."""
    seeds: str = "0-4"
    """Seeds of every combination: A-B or A,B,C."""
    out: Path = Path("sweeps/sweep")
    """Folder of the sweep: its runs, table.csv, table.parquet, figure.svg."""
    preset: str | None = None
    """Named settings to start from (farm tasks NAME lists a task's presets).

    By default the task's first preset.
    """
    config: Path | None = None
    """Settings to start from: a config.json (other flags override it)."""
    sharing: sweeps.Sharing = field(default_factory=sweeps.Sharing)
    """Workers of the runs."""
    run: RunConfig = field(default_factory=RunConfig)
    """Settings of all runs."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    vary = grid.parse_vary(_vary(words))
    # Flags may be of a task or policy that is varied
    first = {name: values[0] for name, values in vary.items()}
    command, _, base = parse(SweepCommand, [*words, *_parts(first)], "farm sweep", _USUAL)
    if command.run.seed != base.seed:
        raise ConfigError("--seed is for one run: give --seeds, for example --seeds 0-4")
    seeds = grid.parse_seeds(command.seeds)
    settings = tuple(_setting(values, words) for values in grid.combinations(vary, len(seeds)))
    sweep = Sweep(command.out, settings, seeds)
    logs.set_up("WARNING")
    prepare(sweep, command.sharing)
    plots.announce()
    with stop_flag("saving and ending") as stop:
        with Runs(sweep.runs, sweep.path) as display:
            complete, table = learnt(sweep, command.sharing, display, stop.is_set)
        if stop.is_set():
            say(
                f"{len(sweeps.todo(sweep.runs))} runs are left; the same command continues with"
                " them"
            )
            return INTERRUPTED
    _print(sweep, table)
    _draw(sweep)
    return 0 if complete else 1


def _vary(words: Sequence[str]) -> list[str]:
    pairs = zip(words, [*words, ""][1:], strict=True)
    return [
        after if word == "--vary" else word[7:]
        for word, after in pairs
        if word.partition("=")[0] == "--vary"
    ]


def _setting(values: dict[str, str], words: Sequence[str]) -> Setting:
    """One combination of values, as `farm run` would take it from these flags."""
    flags = [flag(name, value) for name, value in values.items()]
    try:
        names = configs.flat(parse(SweepCommand, [*words, *_parts(values)], "farm sweep")[2])
        for name in values:
            if name.replace("_", "-") not in names:
                near = meant(name.replace("_", "-"), names)
                raise ConfigError(f"no such setting; known are {', '.join(names)}{near}")
        config = parse(SweepCommand, [*words, *flags], "farm sweep")[0].run
    except ConfigError as error:
        text = " ".join(f"{name}={value}" for name, value in values.items())
        raise ConfigError(f"--vary {text}: {error}" if text else str(error)) from None
    return Setting(values, configs.changed_by(config, {"seed": 0}))


def _parts(values: dict[str, str]) -> list[str]:
    """The flags that choose task, policy and algorithm, because the other flags depend on them."""
    return [flag(name, value) for name, value in values.items() if name in configs.PARTS]


def _print(sweep: Sweep, table: Sequence[dict[str, Any]]) -> None:
    """One line per setting: mean and standard deviation over the seeds."""
    output = compact()
    judged = any(row["robust_success_rate"] is not None for row in table)
    robust = (
        ("robust success", "robust_success_rate") if judged else ("robust return", "robust_return")
    )
    measures = outcomes.measures(table)
    names = [column.removeprefix(outcomes.MEASURE) for column in measures]
    failed = ["robust_failed"] if any(row.get("robust_failed") for row in table) else []
    results = ("untrained", "return", robust[0], *("failed" for _ in failed), *names)
    for name in (*sweep.vary, "runs", *results, "minutes"):
        output.add_column(name, justify="left" if name in sweep.vary else "right", no_wrap=True)
    count = len(sweep.seeds)
    for i, setting in enumerate(sweep.settings):
        rows = table[i * count : (i + 1) * count]
        finished = sum(row["state"] == "finished" for row in rows)
        columns = ("first_mean_policy_return", "mean_policy_return", robust[1], *failed, *measures)
        cells = [
            _spread(outcomes.spread(rows, column), percent=column == "robust_success_rate")
            for column in columns
        ]
        minutes = sum(row["seconds"] or 0.0 for row in rows) / 60
        output.add_row(*setting.values.values(), f"{finished} of {count}", *cells, f"{minutes:.1f}")
    wide().print(output)
    say(
        "mean ± standard deviation over seeds; untrained: the mean policy before learning;"
        f" {sweep.path}/table.csv"
    )
    if not parquet.available():
        say(f"no table.parquet: {parquet.INSTALL}")


def _spread(spread: tuple[float, float] | None, *, percent: bool) -> str:
    if spread is None:
        return ""
    return f"{spread[0]:.0%} ± {spread[1]:.0%}" if percent else f"{spread[0]:.3f} ± {spread[1]:.3f}"


def _draw(sweep: Sweep) -> None:
    """Draw the figure, if matplotlib is installed and there is anything to draw."""
    if not plots.available():
        return
    if curves := outcomes.curves(sweep):
        path = sweep.path / "figure.svg"
        with writing(path):
            figure.draw(curves, path)
        say(f"figure {path}")


class Runs:
    """Shows runs side by side: bars on a terminal, else one line per run."""

    def __init__(self, runs: Mapping[Path, RunConfig], where: Path) -> None:
        self._left, self._all = len(sweeps.todo(runs)), len(runs)
        console = Console()
        columns = (
            TextColumn("{task.description}"),
            BarColumn(None),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        self._bars = Progress(
            *columns, TextColumn("{task.fields[said]}"), console=console, expand=True
        )
        self._live = console.is_terminal
        self._tasks: dict[str, TaskID] = {}
        self._messages: set[str] = set()
        self._total = self._bars.add_task(
            "runs", total=self._all, completed=self._all - self._left, said=""
        )
        say(f"{self._left} of {self._all} runs to do, into {where}")

    def __enter__(self) -> "Runs":
        if self._live:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._bars.stop()

    def progress(self, run: str, generation: int, of: int, returned: float | None) -> None:
        """Show a finished generation."""
        if run not in self._tasks:
            self._tasks[run] = self._bars.add_task(run, total=of, said="")
        value = screen.figure(returned, "8.3f")
        self._bars.update(self._tasks[run], completed=generation, said=value)

    def said(self, run: str, line: str) -> None:
        """Show a learner's message, for example that no worker answers; equal messages are shown
        once.
        """
        if line not in self._messages:
            self._messages.add(line)
            self._print(f"{run}: {line}")

    def ended(self, run: str, state: str, detail: str) -> None:
        """Show the end of a run: finished, diverged, failed or interrupted; `detail` is its reason
        or its result.
        """
        if run in self._tasks:
            self._bars.remove_task(self._tasks.pop(run))
        if state in ("finished", "diverged"):
            self._left -= 1
        self._bars.update(self._total, completed=self._all - self._left)
        self._print(f"{run} {state}" + (f": {detail}" if detail else "") + f"  ({self._left} left)")

    def _print(self, line: str) -> None:
        if self._live:
            self._bars.console.print(plain(line), highlight=False)
        else:
            say(line)
