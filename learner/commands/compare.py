"""`farm compare`: several runs in one recording."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import settings as arguments
from farm.errors import ConfigError, RunError
from learner import comparison
from learner.commands import recordings, view
from learner.replay import loaded
from learner.run import check_rerun
from learner.run_folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class CompareCommand:
    """Several runs in one recording: curves over each other, final policies side by side, a table."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of the runs, two to seven."""
    to: Path = Path("compare.rrd")
    """Recording to write; what is there is replaced."""
    view: bool = False
    """Open it in the Rerun viewer."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(CompareCommand, words, "farm compare")
    check_rerun()
    from learner.recording.comparison import COLOURS, Shown, record_comparison

    if not 2 <= len(command.runs) <= len(COLOURS):
        raise ConfigError(f"{len(command.runs)} runs to compare; expected 2 to {len(COLOURS)}")
    recordings.target(command.to)
    folders = [RunFolder.open(path) for path in command.runs]
    runs = comparison.read(folders)
    shown = []
    for folder, run in zip(folders, runs, strict=True):
        policy = loaded(folder)
        found, final = policy.problem, policy.rollout().trajectory
        shown.append(Shown(run.name, found.scene, found.spec, run.progress, final, found.task.camera))
    try:
        record_comparison(command.to, shown, comparison.table(runs))
    except OSError as error:
        raise RunError(f"cannot write {command.to}: {error.strerror}") from None
    sys.stdout.write(f"written to {command.to}; look at it with: farm view {command.to}\n")
    sys.stdout.flush()
    if command.view:
        view.check_display(str(command.to))
        return view.show([str(command.to)])
    return 0
