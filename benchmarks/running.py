"""What the scripts of this folder share: how they end, and runs that an interrupted script
continues.
"""

import argparse
import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, FarmError, RunError
from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.launch import open_run
from learner.run.setup import fitted
from learner.tools.sweep.command import Runs
from learner.tools.sweep.runs import Sharing, run


def script(main: Callable[[], None]) -> None:
    """Run a script; Ctrl-C and the farm's errors end it with one line instead of a traceback."""
    try:
        main()
    except KeyboardInterrupt:
        sys.stderr.write("stopped before the end\n")
        sys.exit(INTERRUPTED)
    except FarmError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2 if isinstance(error, ConfigError) else 1)


def rows_of(
    file: Path, having: Mapping[str, object] = MappingProxyType({}), *names: str
) -> list[dict[str, Any]]:
    """Rows that a script has measured before and that have these values, one of JSON per line; none
    without the file. Every row has also a value of each of the names.

    Raises:
      ConfigError: the file cannot be read, or is the table of another script.
    """
    try:
        lines = file.read_text("utf-8").splitlines() if file.exists() else []
        rows: list[dict[str, Any]] = [json.loads(line) for line in lines]
        if not all(row.keys() >= {*having, *names} for row in rows):
            raise ValueError("its rows are another script's")
    except (OSError, ValueError, AttributeError) as error:
        raise ConfigError(f"{file}: {error}; name a different file with --out") from None
    return [row for row in rows if all(row[name] == value for name, value in having.items())]


def table_flags(doc: str | None, table: Path, runs: Path, seeds: list[int]) -> ArgumentParser:
    """Flags of a script that learns runs, keeps a row for each in a file, and prints its table."""
    parser = ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=numbers, default=seeds)
    parser.add_argument("--runs", type=Path, default=runs)
    parser.add_argument("--out", type=Path, default=table)
    parser.add_argument(
        "--table", action="store_true", help="print the file's table and measure nothing"
    )
    return parser


def trial_flags(parser: ArgumentParser, starts: int, seconds: int, least: int) -> None:
    """Add flags of how a policy is tried: from how many starts, and for how long [s], which is at
    least some seconds.
    """

    def time(text: str) -> int:
        if not text.isdecimal() or int(text) % 10 or not least <= int(text) <= 1000:
            raise argparse.ArgumentTypeError(f"expected {least}, {least + 10}, ... or 1000")
        return int(text)

    parser.add_argument("--starts", type=count, default=starts)
    parser.add_argument("--seconds", type=time, default=seconds)


def numbers(text: str) -> list[int]:
    """Different whole numbers of a flag, with commas between them."""
    return _distinct(text, int, "whole numbers with commas between them, such as 22,23")


def decimals(text: str) -> list[float]:
    """Different numbers from 0 of a flag, with commas between them."""
    return _distinct(text, float, "numbers from 0 with commas between them, such as 0,0.01")


def _distinct(text: str, kind: Callable[[str], Any], what: str) -> list[Any]:
    try:
        found = list(dict.fromkeys(map(kind, text.split(","))))
    except ValueError:
        found = []
    if not found or not all(0 <= each < 2**63 for each in found):
        raise argparse.ArgumentTypeError(f"expected {what}")
    return found


def count(text: str) -> int:
    """A number of things of a flag, at least one."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError("expected a whole number from 1")
    return int(text)


def keep(file: Path, row: Mapping[str, Any]) -> None:
    """Add a row to the file and show it, so that an interrupted script continues after it."""
    print(dict(row), flush=True)
    with file.open("a", encoding="utf-8") as out:
        out.write(json.dumps(row) + "\n")


def learn_together(runs: Mapping[Path, RunConfig], where: Path, sharing: Sharing) -> None:
    """Learn runs that are not over as `farm sweep` does, several at a time on shared workers.

    The next call continues.

    Raises:
      KeyboardInterrupt: Ctrl-C or SIGTERM; what is learnt so far is saved.
      RunError: a run failed.
    """
    with stop_flag("saving") as stop, Runs(runs, where) as display:
        over = run(runs, sharing, display, stop.is_set)
    if stop.is_set():
        raise KeyboardInterrupt
    if not over:
        raise RunError("some runs failed; see their messages above")


def learn(config: RunConfig, path: Path, workers: int) -> None:
    """Learn a run in this folder, unless it has finished; an interrupted run continues.

    Raises:
      ConfigError: the folder has a run with different settings.
      RunError: the run failed.
    """
    folder = RunFolder(path)
    if path.exists() and folder.read_config() != fitted(config):
        raise ConfigError(
            f"{path} is a run with different settings: remove it, or work in a different folder"
        )
    if (folder.read_summary() or {}).get("state") == "finished":
        return
    place = Placement(workers=workers, listen=free_endpoint())
    with open_run(config, path, place, resume=path.exists()) as run:
        for _ in run.learn():
            pass
