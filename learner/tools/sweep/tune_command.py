"""`farm tune`: a race of policies and algorithms on one task."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rich.live import Live
from rich.table import Table

from farm.commands import logs, screen
from farm.commands.logs import say
from farm.commands.screen import compact, plain, wide
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, writing
from farm.settings import Settings, setting
from learner import plots
from learner.commands.options import USUAL, flag, parse
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.files import replace_text
from learner.tools.sweep import figure, result
from learner.tools.sweep import race as races
from learner.tools.sweep.portfolio import portfolio
from learner.tools.sweep.race import Entry, Race
from learner.tools.sweep.runs import Sharing, site
from learner.tools.sweep.sweep import check_sharing

_USUAL: Final = tuple(name for name in USUAL if name not in ("generations", "policy", "algorithm"))
"""Settings that `farm tune --help` shows: entries differ in the others."""


@dataclass(frozen=True, kw_only=True)
class TuneCommand(Settings):
    """Races policies and algorithms on a task: farm tune TASK. Run it again to continue.

    The worse half is dropped again and again; the best one learns to the end.
    """

    rollouts: int | None = setting(None, least=1, most=races.MOST_ROLLOUTS)
    """Exploring rollouts of all entries together; half of them are the winner's last ones."""
    minutes: float | None = setting(None, above=0.0, most=1e5)
    """Instead of --rollouts: so many rollouts as the local workers do in about this time, measured
    once.
    """
    portfolio: str = "general"
    """What is tried: a name, or FILE.py:CLASS."""
    entry: tuple[str, ...] = ()
    """NAME=V,NAME=V,...: settings that are tried as well, for example
    policy=mlp,algorithm=es,pairs=40; repeatable.
    """
    only: tuple[str, ...] = ()
    """An entry of the portfolio, repeatable; the others are left out."""
    list: bool = False
    """Print the entries as flags of farm run, and do nothing."""
    out: Path | None = None
    """Folder of the race: its runs, result.md, figure.svg; by default tunes/TASK-sSEED."""
    preset: str | None = None
    """Named settings to start from (farm tasks NAME lists a task's presets).

    By default the task's first preset.
    """
    config: Path | None = None
    """Settings to start from: a config.json (other flags override it)."""
    sharing: Sharing = field(default_factory=lambda: Sharing(record=True))
    """Workers of the runs; --no-record: no recording of the winner."""
    run: RunConfig = field(default_factory=RunConfig)
    """Settings of all entries."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rollouts is not None and self.minutes is not None:
            raise ConfigError("--rollouts and --minutes exclude each other")
        if self.minutes is not None and not self.sharing.processes:
            raise ConfigError(
                "--minutes measures this machine, whose workers take no part: give --rollouts"
            )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    words = _task_as_flag(words)
    command, _, base = parse(TuneCommand, words, "farm tune", _USUAL)
    _check_common(command, base)
    entries = _entries(command, words)
    if command.list:
        _list(entries)
        return 0
    if command.rollouts is None and command.minutes is None:
        raise ConfigError(
            "farm tune needs --rollouts or --minutes: how much to try, for example --rollouts 60000"
        )
    path = command.out or Path("tunes") / f"{result.plain(command.run.task)}-s{command.run.seed}"
    race = Race(path, tuple(entries), _rollouts(command, entries, path))
    races.check(race)
    check_sharing(command.sharing)
    logs.set_up("WARNING")
    race.prepare()
    plots.announce()
    with stop_flag("saving and ending") as stop:
        with (
            Standing(race) as display,
            site(command.sharing, [entry.config for entry in entries]) as place,
        ):
            over = race.run(place, display, stop.is_set, record=command.sharing.record)
        if not over:
            say("the same command continues")
            return INTERRUPTED
    _conclude(race, recorded=command.sharing.record)
    return 0


def _task_as_flag(words: Sequence[str]) -> list[str]:
    """The words, with the task of `farm tune TASK` as a flag.

    Raises:
      ConfigError: there is another task as a flag.
    """
    if not words or words[0].startswith("-"):
        return list(words)
    if any(word.partition("=")[0] == "--task" for word in words):
        raise ConfigError(f"--task: the task is {words[0]} already; give one of them")
    return ["--task", *words]


def _check_common(command: TuneCommand, base: RunConfig) -> None:
    """Check that flags for all entries are settings of all entries."""
    if command.run.generations != base.generations:
        raise ConfigError("--generations follows from --rollouts: leave it out")
    for part in ("policy", "algorithm"):
        if getattr(command.run, f"{part}_config") != getattr(base, f"{part}_config"):
            changed = next(name for name, *_ in configs.changes(base, command.run))
            raise ConfigError(
                f"--{changed} is a setting of one {part}, but entries differ in theirs: put it into"
                " an --entry"
            )


def _entries(command: TuneCommand, words: Sequence[str]) -> list[Entry]:
    """The chosen entries of the portfolio, and those of the flags."""
    table = portfolio(command.portfolio)
    if unknown := [name for name in command.only if name not in table]:
        raise ConfigError(f"--only {unknown[0]}: no such entry; known are {', '.join(table)}")
    entries = races.entries_of(
        command.run, {k: v for k, v in table.items() if not command.only or k in command.only}
    )
    for text in command.entry:
        name = result.plain(text)
        with races.described(text):
            flags = [flag(*pair) for pair in _pairs(text)]
            entries.append(
                races.entry_of(name, parse(TuneCommand, [*words, *flags], "farm tune")[0].run)
            )
    return entries


def _pairs(text: str) -> list[tuple[str, str]]:
    pairs = [part.partition("=") for part in text.split(",")]
    if not all(name.strip() and equals and value.strip() for name, equals, value in pairs):
        raise ConfigError(
            "not of the form NAME=VALUE,NAME=VALUE, for example policy=mlp,algorithm=es,pairs=40"
        )
    return [(name.strip().lstrip("-"), value.strip()) for name, _, value in pairs]


def _list(entries: Sequence[Entry]) -> None:
    table = compact()
    for column in ("entry", "rollouts per generation", "flags of farm run"):
        table.add_column(column, no_wrap=column == "entry")
    for entry in entries:
        table.add_row(
            entry.name, str(entry.per_generation), plain(shlex.join(configs.flags(entry.config)))
        )
    wide().print(table)


def _rollouts(command: TuneCommand, entries: Sequence[Entry], path: Path) -> int:
    """The number of rollouts: as given, as measured, or as measured when the race began."""
    if command.minutes is None:
        assert command.rollouts is not None
        return command.rollouts
    if (path / "race.json").exists():
        return int(races.read(path / "race.json")["rollouts"])
    count = races.affordable(entries, command.minutes, command.sharing.processes)
    workers = command.sharing.processes
    say(
        f"{command.minutes:g} minutes are some {count} rollouts on {workers} workers: as --rollouts"
        f" {count} from now on"
    )
    return count


def _conclude(race: Race, *, recorded: bool) -> None:
    """Write the page and the figure, and say who has won."""
    drawable = plots.available()
    with writing(f"to {race.path}"):
        if drawable:
            figure.draw(
                result.curves(race),
                race.path / "figure.svg",
                [rung.rollouts for rung in race.rungs],
            )
        replace_text(race.path / "result.md", result.page(race, figure=drawable))
    wide().print(_table(race))
    folder = race.folder(race.winner)
    say(result.verdict(race).replace("**", ""))
    say(f"the numbers are mean returns from perturbed starts: {race.path}/result.md")
    say(f"without the race: {result.command(race)}")
    say(f"look at it with: farm {'view' if recorded else 'replay'} {folder}")


def _table(race: Race, now: Mapping[str, str] | None = None) -> Table:
    """One line per entry, best first; `now` has the state of those that run."""
    table = compact()
    for head in (*result.heads(race), *([] if now is None else ["now"])):
        table.add_column(
            head, justify="left" if head in ("entry", "now") else "right", no_wrap=True
        )
    for name, *scores in result.rows(race):
        table.add_row(name, *scores, *([] if now is None else [now.get(name, "")]))
    return table


class Standing:
    """Shows a race: a live table on a terminal, else a line per rung and per entry that ends
    one.
    """

    def __init__(self, race: Race) -> None:
        self._race, self._now = race, dict[str, str]()
        self._names = {race.folder(entry).name: entry.name for entry in race.entries}
        self._console = wide()
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._messages: set[str] = set()

    def __enter__(self) -> "Standing":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def rung(self, number: int) -> None:
        """Say who takes part in a rung."""
        rung, names = self._race.rungs[number], [entry.name for entry in self._race.running(number)]
        self._now = dict.fromkeys(names, "waits")
        if not self._draw():
            say(
                f"rung {number + 1} of {len(self._race.rungs)}, to {rung.rollouts} rollouts each:"
                f" {', '.join(names)}"
            )

    def progress(self, run: str, generation: int, of: int, returned: float | None) -> None:
        """Show a finished generation."""
        value = screen.figure(returned, ".4g")
        self._now[self._names[run]] = f"{generation} of {of} generations, {value}"
        self._draw()

    def said(self, run: str, line: str) -> None:
        """Show a learner's message, for example that no worker answers; equal messages are shown
        once.
        """
        if line not in self._messages:
            self._messages.add(line)
            self._console.print(plain(f"{run}: {line}"), highlight=False)

    def ended(self, run: str, state: str, detail: str) -> None:
        """Show that an entry has ended its rung."""
        self._now[self._names[run]] = state
        if not self._draw() or state == "failed":
            self._console.print(
                plain(f"{run} {state}" + (f": {detail}" if detail else "")), highlight=False
            )

    def _draw(self) -> bool:
        """Draw the live table; return whether there is one."""
        if self._console.is_terminal:
            self._live.update(_table(self._race, self._now), refresh=True)
        return self._console.is_terminal
