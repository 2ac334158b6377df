"""`farm verify`: repeats a run, and compares its numbers."""

import json
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from farm import __version__, fingerprint, settings
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, writing
from farm.link import Link
from farm.net.session import free_endpoint
from farm.settings import setting
from learner.again.verify import Differs, chosen, stored, verify_all, verify_some
from learner.run import checkpoint as checkpoints
from learner.run.files import replace_text
from learner.run.folder import RunFolder
from learner.run.launch import MOST_WORKERS, Placement


@dataclass(frozen=True, kw_only=True)
class VerifyCommand(Link):
    """Repeats a run, and compares its numbers to the last bit; exit status 1 if one differs.

    By default some of its generations, from the stored parameters before them; --all: the whole run.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    share: float = setting(0.1, above=0.0, most=1.0)
    """Share of the generations, chosen at random; at least one."""
    all: bool = False
    """Learn the run again from its start: also checks the updates and the results."""
    workers: int | None = setting(None, least=0, most=MOST_WORKERS)
    """Local worker processes for --all; by default one per core, with --connect none."""
    receipt: Path | None = None
    """Write what was verified to this file, as JSON."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.all and (self.connect or self.workers is not None):
            raise ConfigError("--workers and --connect are for --all: some generations are repeated in this process")
        if self.connect and self.workers:
            raise ConfigError("--workers with --connect: a farm has workers of its own")
        if self.workers == 0 and not self.connect:
            raise ConfigError("--workers 0 without --connect: there would be no workers")
        if self.tls is not None and not self.connect:
            raise ConfigError("--tls is for a farm to --connect to: without one everything stays on this machine")

    @property
    def place(self) -> Placement:
        """Where the whole run is repeated."""
        count = self.workers if self.workers is not None else 0 if self.connect else os.cpu_count() or 1
        return Placement(
            workers=count, listen=free_endpoint(), connect=self.connect, farm=self.farm, tls=self.bundle, record=False
        )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = settings.parse(VerifyCommand, words, "farm verify")
    logs.set_up("WARNING")
    folder = RunFolder.open(command.run)
    receipt: dict[str, Any] = {
        "run": folder.name, "release": __version__, "numbers": fingerprint.digest(), "generations": [], "rollouts": 0,
        "difference": None,
    }  # fmt: skip
    try:
        return _verify(command, folder, receipt)
    except Differs as error:
        receipt["difference"] = str(error)
        raise
    finally:
        if command.receipt is not None and "code" in receipt:
            with writing(f"to {command.receipt}"):
                replace_text(command.receipt, json.dumps(receipt, indent=2) + "\n")


def _verify(command: VerifyCommand, folder: RunFolder, receipt: dict[str, Any]) -> int:
    receipt["code"] = checkpoints.load(folder.checkpoint).code
    run = stored(folder)
    if not run.last:
        raise ConfigError(f"the run in {folder.path} has done no generation: there is nothing to verify")
    receipt["parameters_sha256"] = run.sha256
    some = range(1, run.last + 1)
    if not command.all:
        some = chosen(run, command.share, np.random.default_rng(secrets.randbits(64)))
    done: list[int] = receipt["generations"]
    with stop_flag("ending") as stop:
        repeated = verify_all(run, command.place, stop.is_set) if command.all else verify_some(run, some)
        for generation, rollouts in _shown(repeated, len(some)):
            done.append(generation)
            receipt["rollouts"] += rollouts
            if stop.is_set():
                break
    said = f"{len(done)} of {run.last} generations of {folder.path}, {receipt['rollouts']} rollouts"
    if len(done) < len(some):
        say(f"stopped; no difference in {said}")
        return INTERRUPTED
    say(f"verified to the bit: {said}" + (", and the results" if command.all else "; --all also repeats the updates"))
    return 0


def _shown(repeated: Iterator[tuple[int, int]], count: int) -> Iterable[tuple[int, int]]:
    """Show a bar on a terminal."""
    console = Console()
    return track(repeated, "generations", total=count, console=console) if console.is_terminal else repeated
