"""`farm compare`: several runs in one recording."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.table import Table

from farm import command_line
from farm.commands.logs import say
from farm.commands.screen import compact, figure, plain, wide
from farm.errors import ConfigError, writing
from farm.net.stats import GenerationStats
from farm.targets import typed
from learner.commands import recordings
from learner.commands.of_run import OfRun
from learner.recording.files import check_rerun
from learner.run.config import RunConfig, flat, preset_of
from learner.run.folder import RunFolder
from learner.tools.replay.loaded import loaded
from learner.tools.view import command as view


@dataclass(frozen=True, kw_only=True)
class CompareCommand(OfRun):
    """Puts several runs into one recording: their curves together, final policies side by side, a
    table.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs, two to seven."""
    to: Path = Path("compare.rrd")
    """Recording to write; an existing file is replaced."""
    view: bool = False
    """Open it in the Rerun viewer."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(CompareCommand, words, "farm compare")
    check_rerun()
    from learner.recording.comparison import Side, record_comparison
    from learner.recording.curves import PALETTE
    from learner.recording.drawing import Drawing

    if not 2 <= len(command.runs) <= len(PALETTE):
        raise ConfigError(f"farm compare takes 2 to {len(PALETTE)} runs, not {len(command.runs)}")
    recordings.target(command.to)
    folders = [RunFolder.open(path, command.allow_file) for path in command.runs]
    runs = read(folders)
    sides = []
    for folder, run in zip(folders, runs, strict=True):
        policy = loaded(folder, last=command.last)
        sides.append(
            Side(run.name, Drawing.of(policy.problem), run.progress, policy.rollout().trajectory)
        )
    with writing(command.to):
        record_comparison(command.to, sides, table(runs))
    wide().print(shown(runs))
    say(f"written to {command.to}; look at it with: farm view {typed(command.to)}")
    if command.view:
        view.check_display(str(command.to))
        return view.show([str(command.to)])
    return 0


@dataclass(frozen=True)
class Compared:
    """Run that is compared with others."""

    name: str
    """Including its own settings."""
    config: RunConfig
    progress: Sequence[GenerationStats]
    summary: Mapping[str, Any]
    """Empty if there is none yet."""


def read(folders: Sequence[RunFolder]) -> list[Compared]:
    """The contents of the folders.

    Raises:
      ConfigError: one is of another release, or has done no generation yet.
    """
    runs = []
    for name, folder in zip(names([folder.path for folder in folders]), folders, strict=True):
        config = folder.read_config()
        progress = folder.progress()
        if not progress:
            raise ConfigError(
                f"the run in {folder.path} has done no generation yet: nothing to compare"
            )
        runs.append(Compared(name, config, progress, folder.read_summary() or {}))
    return runs


def names(paths: Sequence[Path]) -> list[str]:
    """A unique name for each folder: its own, preceded by those of parent folders as long as two
    are equal.
    """
    whole = [path.resolve() for path in paths]
    for path, folder in zip(whole, paths, strict=True):
        if whole.count(path) > 1:
            raise ConfigError(f"{folder} is there twice; each run once")
    depth = 1
    while len({path.parts[-depth:] for path in whole}) < len(whole):
        depth += 1
    return ["/".join(path.parts[-depth:]) for path in whole]


def shown(runs: Sequence[Compared]) -> Table:
    """The same table for a terminal, one line per run where all fit beside each other."""
    table = compact()
    for head in ("", *(run.name for run in runs)):
        table.add_column(plain(head), justify="right" if head else "left", overflow="fold")
    for row in _rows(runs):
        table.add_row(*map(plain, row))
    return table


def _rows(runs: Sequence[Compared]) -> list[tuple[str, ...]]:
    return [*_results(runs), *_settings(runs)]


def table(runs: Sequence[Compared]) -> str:
    """A Markdown table with one column per run; settings that are equal in all runs are left
    out.
    """
    rows = [("", *(f"**{run.name}**" for run in runs)), *_rows(runs)]
    first, *rest = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([first, f"|{'---|' * (len(runs) + 1)}", *rest])


def _settings(runs: Sequence[Compared]) -> Iterator[tuple[str, ...]]:
    yield "preset", *(preset_of(run.config) for run in runs)
    tables = [flat(run.config) for run in runs]
    for name in dict.fromkeys(name for table in tables for name in table):
        values = [table[name] for table in tables if name in table]
        if any(value != values[0] for value in values):
            yield name, *(str(table.get(name, "-")) for table in tables)


def _results(runs: Sequence[Compared]) -> Iterator[tuple[str, ...]]:
    def cells(key: str, form: str) -> tuple[str, ...]:
        values = [run.summary.get(key) for run in runs]
        return tuple(figure(value, form) for value in values)

    yield "generations done", *(str(run.progress[-1].generation) for run in runs)
    yield "rollouts", *(str(run.progress[-1].rollouts) for run in runs)
    yield "return of the final policy", *cells("mean_policy_return", ".3f")
    if any(p.mean_policy_success is not None for run in runs for p in run.progress):
        yield "it succeeds", *(_succeeds(run.summary) for run in runs)
        yield "robust success", *cells("robust_success_rate", ".0%")
        firsts = (
            next((p.generation - 1 for p in run.progress if p.mean_policy_success), None)
            for run in runs
        )
        yield (
            "first success, generation",
            *("-" if first is None else str(first) for first in firsts),
        )
    yield "seconds", *(f"{run.progress[-1].seconds:.0f}" for run in runs)
    yield "hash", *(str(run.summary.get("parameters_sha256") or "-")[:8] for run in runs)


def _succeeds(summary: Mapping[str, Any]) -> str:
    success = {True: "yes", False: "no", None: "-"}[summary.get("mean_policy_success")]
    return "cut short" if success == "no" and summary.get("state") != "finished" else success
