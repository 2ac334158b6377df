"""`farm export`: a learnt policy as one file, for plain MuJoCo and numpy or as an ONNX model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from farm import command_line
from farm.commands.logs import say
from farm.errors import ConfigError, printable
from farm.settings import setting
from learner.commands.of_run import OfRun
from learner.run.config import MOST_GENERATIONS
from learner.run.folder import RunFolder
from learner.tools.export import interface, onnx
from learner.tools.export.export import export, form
from learner.tools.replay.loaded import loaded


@dataclass(frozen=True, kw_only=True)
class ExportCommand(OfRun):
    """Writes a learnt policy to a file, for MuJoCo and numpy or as an ONNX model; see
    docs/export.md.
    """

    run: tyro.conf.Positional[Path]
    """Folder of the run; with --list also an exported file."""
    to: tyro.conf.Positional[Path | None] = None
    """File to write: .npz (with the task, for MuJoCo and numpy) or .onnx (the policy alone)."""
    list: bool = False
    """Print what the file says, or would say, of observations, actions, joints and code; write
    nothing.
    """
    generation: int | None = setting(None, least=0, most=MOST_GENERATIONS)
    """Generation whose mean policy is written (0: before learning); by default the run's policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.list:
            if self.to is not None:
                raise ConfigError(
                    f"{self.to}: --list writes no file; expected one path, of a run or of a file"
                )
        elif self.to is None:
            raise ConfigError("no file to write: expected a name that ends in .npz or .onnx")
        else:
            form(self.to)


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(ExportCommand, words, "farm export")
    if command.to is None:
        for line in listed(command.run, command.generation, command.allow_file, last=command.last):
            say(printable(line))
        return 0
    policy = export(
        command.run,
        command.to,
        generation=command.generation,
        last=command.last,
        allow_file=command.allow_file,
    )
    size = command.to.stat().st_size
    say(
        f"mean policy after generation {policy.generation} written to {command.to},"
        f" {size >> 10} KiB"
    )
    return 0


def listed(
    path: Path, generation: int | None = None, files: tuple[Path, ...] = (), *, last: bool = False
) -> list[str]:
    """What an exported file says, or the export of a run would say.

    Raises:
      ConfigError: it is neither.
    """
    of: dict[str, Any]
    if path.suffix in (".npz", ".onnx") and not path.is_dir():
        if not path.exists():
            raise ConfigError(f"there is no file {path}")
        if generation is not None or last:
            raise ConfigError(f"{path} has one policy: give its run for another")
        of, more = (onnx.listed if path.suffix == ".onnx" else interface.of_npz)(path)
    else:
        of, more = interface.of_run(loaded(RunFolder.open(path, files), generation, last=last)), []
    return [*interface.lines(path, of), *more]
