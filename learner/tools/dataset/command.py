"""`farm dataset`: episodes of a learnt policy as a data set."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import Progress

from farm import command_line
from farm.commands import logs
from farm.commands.logs import say
from farm.commands.screen import Console
from farm.commands.signals import INTERRUPTED, stop_flag
from farm.errors import ConfigError, RunError
from farm.link import Link
from farm.net.session import free_endpoint
from farm.processes import cores
from farm.seeds import SEEDS
from farm.settings import setting
from farm.targets import check_target
from learner import parquet
from learner.commands.of_run import OfRun
from learner.pool.placement import MOST_WORKERS, Placement
from learner.pool.pool import Stopped
from learner.run.folder import RunFolder
from learner.tools.dataset.dataset import MOST_EPISODES, DataSet, difference, read


@dataclass(frozen=True, kw_only=True)
class DatasetCommand(OfRun, Link):
    """Writes episodes of a learnt policy as a data set in LeRobot's format; see docs/files.md.

    An interrupted command continues when it is repeated.
    """

    run: tyro.conf.Positional[Path | None] = None
    """Folder of the run."""
    manifest: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Make the data set of this manifest.json again, and compare the bytes."""
    out: Path | None = None
    """Folder of the data set; needed."""
    episodes: int | None = setting(None, least=1, most=MOST_EPISODES)
    """Number of episodes; 1000 by default."""
    seed: int | None = setting(None, least=0, most=SEEDS - 1)
    """Seed of the starts; 1 by default, as farm evaluate has 0."""
    workers: int | None = setting(None, least=1, most=MOST_WORKERS)
    """Local worker processes; by default one per core. With --connect there are none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.run is None) == (self.manifest is None):
            raise ConfigError("expected the folder of a run, or --from with a manifest.json")
        if self.out is None:
            raise ConfigError("expected --out with the folder of the data set")
        if self.manifest and (self.episodes or self.seed is not None or self.last):
            raise ConfigError(
                "--from: the manifest says how many episodes, their seed and which policy"
            )
        if self.connect and self.workers:
            raise ConfigError("--workers with --connect: a farm has workers of its own")
        if self.tls is not None and not self.connect:
            raise ConfigError(
                "--tls is for a farm to --connect to: without one everything stays on this machine"
            )

    @property
    def place(self) -> Placement:
        """Where the episodes are simulated."""
        count = 0 if self.connect else self.workers or cores()
        return Placement(
            workers=count,
            listen=free_endpoint(),
            connect=self.connect,
            farm=self.farm,
            tls=self.bundle,
        )


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(DatasetCommand, words, "farm dataset")
    if not parquet.available():
        raise ConfigError(f"data sets are Parquet files; {parquet.INSTALL}")
    logs.set_up("WARNING")
    assert command.out is not None
    check_target("--out", command.out, folder=True)
    if command.manifest is not None:
        of = read(command.manifest)
        data = DataSet(
            command.out, of["episodes"], of["seed"], command.allow_file, of.get("last", False)
        )
        run = command.manifest.parent / "run"
    else:
        assert command.run is not None
        seed = 1 if command.seed is None else command.seed
        data = DataSet(
            command.out, command.episodes or 1000, seed, command.allow_file, command.last
        )
        run = command.run
    if data.begin(RunFolder.open(run, data.files)):
        say(f"{command.out} is complete")
    elif not _make(data, command.place):
        return INTERRUPTED
    if command.manifest is not None:
        if text := difference(command.manifest, data.manifest):
            raise RunError(f"{command.out} differs from {command.manifest}: {text}")
        data.check_files()
        say(f"the same bytes as {command.manifest} says")
    return 0


def _make(data: DataSet, place: Placement) -> bool:
    """Make a data set, with a bar on a terminal; return whether it is complete."""
    console = Console()
    with (
        Progress(console=console, disable=not console.is_terminal) as bar,
        stop_flag("ending") as stop,
    ):
        task = bar.add_task("episodes", total=data.episodes)
        try:
            for done in data.make(place, stop.is_set):
                bar.update(task, completed=done)
        except Stopped:
            say("stopped; the same command continues")
            return False
    manifest = read(data.manifest)
    files, numbers = manifest["files"], manifest["numbers_sha256"]
    say(f"{data.episodes} episodes in {data.path}: {len(files)} files, numbers {numbers[:16]}")
    return True
