"""`farm sweep`: settings x seeds on one set of workers; a table and a figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import compact, plain, wide
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, writing
from farm.settings import Settings
from learner import parquet
from learner.commands.options import flag, parse
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.launch import check_rerun
from learner.run.setup import problem
from learner.sweep import figure, grid, outcomes
from learner.sweep import runs as sweep
from learner.sweep.grid import Setting, Sweep


@dataclass(frozen=True, kw_only=True)
class SweepCommand(Settings):
    """Learns settings x seeds on one set of workers; makes table and figure. Run it again to continue."""

    vary: tuple[str, ...] = ()
    """NAME=V1,V2,...: a setting and its values, repeatable; every combination is learnt."""
    seeds: str = "0-4"
    """Seeds of every combination: A-B or A,B,C."""
    out: Path = Path("sweeps/sweep")
    """Folder of the sweep: its runs, table.csv, table.parquet, figure.svg."""
    preset: str | None = None
    """Named settings to start from (farm tasks NAME lists a task's presets); by default the task's first preset."""
    config: Path | None = None
    """Settings to start from: a config.json (other flags override it)."""
    sharing: sweep.Sharing = field(default_factory=sweep.Sharing)
    """Workers of the runs."""
    run: RunConfig = field(default_factory=RunConfig)
    """Settings of all runs."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    vary = grid.parse_vary(_given(words))
    first = {name: values[0] for name, values in vary.items()}  # flags may be of a task or policy that is varied
    command, _, begin = parse(SweepCommand, [*words, *_parts(first)], "farm sweep")
    if command.run.seed != begin.seed:
        raise ConfigError("--seed is for one run: give --seeds, for example --seeds 0-4")
    seeds = grid.parse_seeds(command.seeds)
    settings = tuple(_setting(values, words) for values in grid.combinations(vary, len(seeds)))
    chosen = Sweep(command.out, settings, seeds)
    grid.check(chosen)
    check_sharing(command.sharing)
    _check_begins(chosen)
    logs.set_up("WARNING")
    chosen.prepare()
    with stop_flag("saving and ending") as stop:
        with Runs(chosen.runs, chosen.path) as shown:
            complete = sweep.run(chosen.runs, command.sharing, shown, stop.is_set)
        table = outcomes.rows(chosen)
        outcomes.write_csv(chosen.path / "table.csv", chosen, table)
        if parquet.available():
            outcomes.write_parquet(chosen.path / "table.parquet", chosen, table)
        if stop.is_set():
            say(f"{len(sweep.todo(chosen.runs))} runs are left; the same command continues with them")
            return INTERRUPTED
    _print(chosen, table)
    _draw(chosen)
    return 0 if complete else 1


def _given(words: Sequence[str]) -> list[str]:
    pairs = zip(words, [*words, ""][1:], strict=True)
    return [after if word == "--vary" else word[7:] for word, after in pairs if word.partition("=")[0] == "--vary"]


def _setting(values: dict[str, str], words: Sequence[str]) -> Setting:
    """One combination of values, as `farm run` would take it from these flags."""
    own = [flag(name, value) for name, value in values.items()]
    try:
        known = configs.flat(parse(SweepCommand, [*words, *_parts(values)], "farm sweep")[2])
        for name in values:
            if name.replace("_", "-") not in known:
                raise ConfigError(f"no such setting; known are {', '.join(known)}")
        config = parse(SweepCommand, [*words, *own], "farm sweep")[0].run
    except ConfigError as error:
        given = " ".join(f"{name}={value}" for name, value in values.items())
        raise ConfigError(f"--vary {given}: {error}" if given else str(error)) from None
    return Setting(values, configs.changed_by(config, {"seed": 0}))


def _parts(values: dict[str, str]) -> list[str]:
    """The flags that choose task, policy and algorithm, because the other flags depend on them."""
    return [flag(name, value) for name, value in values.items() if name in configs.PARTS]


def _check_begins(chosen: Sweep) -> None:
    """Check that every setting's task can start: better now than hours later."""
    begun: list[Any] = []
    for setting in chosen.settings:
        try:
            found = problem(setting.config)
            if (task := (setting.config.task, setting.config.task_config)) not in begun:
                found.runner().close()
                begun.append(task)
        except ConfigError as error:
            raise ConfigError(f"{setting.label}: {error}") from None


def _print(chosen: Sweep, table: Sequence[dict[str, Any]]) -> None:
    """One line per setting: mean and standard deviation over the seeds."""
    shown = compact()
    judged = any(row["robust_success_rate"] is not None for row in table)
    robust = ("robust success", "robust_success_rate") if judged else ("robust return", "robust_return")
    measured = outcomes.measures(table)
    names = [column.removeprefix(outcomes.MEASURE) for column in measured]
    for name in (*chosen.vary, "runs", "untrained", "return", robust[0], *names, "minutes"):
        shown.add_column(name, justify="left" if name in chosen.vary else "right", no_wrap=True)
    count = len(chosen.seeds)
    for i, setting in enumerate(chosen.settings):
        mine = table[i * count : (i + 1) * count]
        finished = sum(row["state"] == "finished" for row in mine)
        columns = ("first_mean_policy_return", "mean_policy_return", robust[1], *measured)
        cells = [_spread(outcomes.spread(mine, column), percent=column == "robust_success_rate") for column in columns]
        minutes = sum(row["seconds"] or 0.0 for row in mine) / 60
        shown.add_row(*setting.values.values(), f"{finished} of {count}", *cells, f"{minutes:.1f}")
    wide().print(shown)
    say(f"mean ± standard deviation over seeds; untrained: the mean policy before learning; {chosen.path}/table.csv")
    if not parquet.available():
        say(f"no table.parquet: {parquet.INSTALL}")


def _spread(found: tuple[float, float] | None, *, percent: bool) -> str:
    if found is None:
        return ""
    return f"{found[0]:.0%} ± {found[1]:.0%}" if percent else f"{found[0]:.3f} ± {found[1]:.3f}"


def _draw(chosen: Sweep) -> None:
    """Draw the figure, if matplotlib is installed and there is anything to draw."""
    if not figure.available():
        say(f"no figure: {figure.INSTALL}")
        return
    if found := outcomes.curves(chosen):
        path = chosen.path / "figure.svg"
        with writing(path):
            figure.draw(found, path)
        say(f"figure {path}")


def check_sharing(sharing: sweep.Sharing) -> None:
    """Check what the runs need: Rerun for recordings, and certificates."""
    if sharing.record:
        check_rerun()
    _ = sharing.bundle


class Runs:
    """Shows runs side by side: bars on a terminal, else one line per run."""

    def __init__(self, runs: Mapping[Path, RunConfig], where: Path) -> None:
        self._left, self._all = len(sweep.todo(runs)), len(runs)
        console = Console()
        columns = TextColumn("{task.description}"), BarColumn(None), MofNCompleteColumn(), TimeRemainingColumn()
        self._bars = Progress(*columns, TextColumn("{task.fields[said]}"), console=console, expand=True)
        self._live = console.is_terminal
        self._tasks: dict[str, TaskID] = {}
        self._heard: set[str] = set()
        self._total = self._bars.add_task("runs", total=self._all, completed=self._all - self._left, said="")
        say(f"{self._left} of {self._all} runs to do, into {where}")

    def __enter__(self) -> "Runs":
        if self._live:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._bars.stop()

    def progress(self, run: str, generation: int, of: int, returned: float) -> None:
        """Show a finished generation."""
        if run not in self._tasks:
            self._tasks[run] = self._bars.add_task(run, total=of, said="")
        self._bars.update(self._tasks[run], completed=generation, said=f"{returned:8.3f}")

    def said(self, run: str, line: str) -> None:
        """Show a learner's message, for example that no worker answers; equal messages are shown once."""
        if line not in self._heard:
            self._heard.add(line)
            self._print(f"{run}: {line}")

    def ended(self, run: str, state: str, said: str) -> None:
        """Show the end of a run: finished, diverged, failed or interrupted; `said` is its reason or its result."""
        if run in self._tasks:
            self._bars.remove_task(self._tasks.pop(run))
        if state in ("finished", "diverged"):
            self._left -= 1
        self._bars.update(self._total, completed=self._all - self._left)
        self._print(f"{run} {state}" + (f": {said}" if said else "") + f"  ({self._left} left)")

    def _print(self, line: str) -> None:
        if self._live:
            self._bars.console.print(plain(line), highlight=False)
        else:
            say(line)
