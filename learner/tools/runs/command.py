"""`farm runs`: a table of the runs in a folder, or a catalog of their recordings."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro
from rich.table import Table

from farm import command_line
from farm.commands.logs import say
from farm.commands.screen import compact, plain, wide
from farm.commands.signals import stop_flag
from farm.errors import CheckpointError, ConfigError, Interrupted
from farm.net.zenoh_settings import is_port
from farm.settings import Settings
from learner.recording.files import check_rerun
from learner.run import checkpoint as checkpoints
from learner.run.evaluation import EVALUATION_ROLLOUTS
from learner.run.folder import RunFolder

LEGEND: Final = (
    "return, success: of the run's policy from the undisturbed start;",
    f"worth, robust: its mean return and its success from {EVALUATION_ROLLOUTS} perturbed starts",
)
"""What the columns are."""


@dataclass(frozen=True, kw_only=True)
class RunsCommand(Settings):
    """Prints a table of the runs in a folder."""

    dir: tyro.conf.Positional[Path] = Path("runs")
    """Folder that holds run folders."""
    json: bool = False
    """Print JSON instead of a table."""
    csv: bool = False
    """Print CSV instead of a table: one column per field of summary.json."""
    serve: str | None = None
    """Serve the recordings as a data set of Rerun's catalog on this port of this machine, until
    Ctrl-C.
    """


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(RunsCommand, words, "farm runs")
    if command.json + command.csv + (command.serve is not None) > 1:
        raise ConfigError("--json, --csv and --serve exclude each other")
    if command.dir.exists() and not command.dir.is_dir():
        raise ConfigError(f"{command.dir} is a file; expected a folder of runs")
    if not command.dir.is_dir():
        raise ConfigError(
            f"there is no folder {command.dir}; runs are made there by farm run --out {command.dir}"
        )
    folders = [RunFolder(path.parent) for path in sorted(command.dir.glob("*/config.json"))]
    if command.serve is not None:
        return _serve(folders, command.dir.resolve().name, command.serve)
    rows = [_row(folder) for folder in folders]
    if not rows and (command.dir / "config.json").exists():
        raise ConfigError(f"{command.dir} is a run: give the folder that holds it")
    if command.json:
        say(json.dumps(rows, indent=2))
        return 0
    if command.csv:
        say(*_csv(rows))
    elif rows:
        table = _table(rows)
        wide(table).print(table)
        say(*LEGEND)
    else:
        say(f"there are no runs in {command.dir}")
    return 0


def _csv(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines with a column for each field; values that are tables or lists are JSON."""
    text = io.StringIO()
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        tables = {name: json.dumps(v) for name, v in row.items() if isinstance(v, dict | list)}
        writer.writerow({**row, **tables})
    return text.getvalue().splitlines()


def _table(rows: Sequence[dict[str, Any]]) -> Table:
    """A line for each run."""
    table = compact()
    for name in ("run", "state", "done", "return", "worth", "success", "robust", "hash"):
        left = name in ("run", "state", "hash")
        table.add_column(
            name,
            justify="left" if left else "right",
            no_wrap=name not in ("run", "state"),
            overflow="fold",
        )
    for row in rows:
        robust = row["robust_success_rate"]
        value = row["mean_policy_return"]
        worth = row["robust_score"]
        what = (
            row["run"],
            row["state"],
            str(row["generations"]),
            "" if value is None else f"{value:.3f}",
            "" if worth is None else f"{worth:.4g}",
            _succeeds(row),
            "" if robust is None else f"{robust:.0%}",
            (row["parameters_sha256"] or "")[:8],
        )
        table.add_row(*(plain(text or "") for text in what))
    return table


def _serve(folders: Sequence[RunFolder], name: str, port: str) -> int:
    """Serve recordings of runs as one data set of Rerun's catalog until Ctrl-C.

    Raises:
      ConfigError: the port is none or in use, or there are no recordings.
      Interrupted: it was stopped.
    """
    if not is_port(port):
        raise ConfigError(
            f"--serve {port!r} is no port; take one from 1 to 65535, for example 51234"
        )
    check_rerun()
    from learner.recording.files import parts
    from learner.recording.viewing import catalog

    recordings: dict[str, Path] = {}
    for folder in folders:
        if files := parts(folder.path / "run.rrd"):
            first = recordings.setdefault(_recording(folder), files[0])
            if first != files[0]:  # a data set has one segment of each id
                say(
                    f"{folder.path} is left out: it is a copy of {first.parent}, with the same"
                    " recording's id"
                )
    if not recordings:
        raise ConfigError("none of these runs has a recording: learn without --no-record")
    with (
        stop_flag("closing the catalog") as stop,
        catalog(name, [*recordings.values()], int(port)) as address,
    ):
        count = "1 recording" if len(recordings) == 1 else f"{len(recordings)} recordings"
        say(f"{count} at {address}: farm view {address}, or rerun.catalog.CatalogClient in Python")
        stop.wait()
    raise Interrupted("the catalog is closed")


def _recording(folder: RunFolder) -> str:
    """The id of a run's recording, which a copy of its folder keeps."""
    try:
        at = checkpoints.load(folder.checkpoint)
    except CheckpointError:
        return folder.name
    return f"{at.run}-undone{at.undone}" if at.undone else at.run


def _succeeds(row: dict[str, Any]) -> str:
    """Whether the run's policy succeeds; unknown if the run was cut short."""
    if row["mean_policy_success"] is False and row["state"] != "finished":
        return "not yet"
    return {True: "yes", False: "no", None: ""}[row["mean_policy_success"]]


def _row(folder: RunFolder) -> dict[str, Any]:
    """A run's summary; what it lacks, because the run was cut short or has not ended, is taken
    from the progress.
    """
    summary = folder.read_summary()
    last = folder.last_progress()
    damaged = _damaged(folder)
    row = {
        "run": folder.name,
        "state": damaged or "running or killed",
        "generations": last.generation if last else 0,
        "rollouts": last.rollouts if last else 0,
        "mean_policy_return": last.mean_policy_return if last else None,
        "mean_policy_success": last.mean_policy_success if last else None,
        "robust_score": None,
        "robust_success_rate": None,
        "parameters_sha256": None,
    }
    if not summary or (last and summary.get("generations") != last.generation):
        return row
    # A copy has a name of its own
    of_folder = {"run", "state"} if damaged else {"run"}
    return row | {
        name: value
        for name, value in summary.items()
        if value is not None and name not in of_folder or name not in row
    }


def _damaged(folder: RunFolder) -> str:
    """What is wrong with a file of a run, without which its policy cannot be read; empty if nothing
    is.
    """
    try:
        json.loads((folder.path / "config.json").read_bytes())
    except ValueError:
        return "config.json is damaged"
    if folder.read_summary() is None and (folder.path / "summary.json").exists():
        return "summary.json is damaged"
    try:
        if folder.checkpoint.exists():
            checkpoints.load(folder.checkpoint)
    except CheckpointError:
        return "checkpoint cannot be read"
    return ""
