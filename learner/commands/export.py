"""`farm export`: a learnt policy as one file, for plain MuJoCo and numpy or as an ONNX model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from farm import settings as arguments
from farm.commands.logs import say
from farm.errors import ConfigError
from farm.settings import Settings, setting
from learner.again.replay import loaded
from learner.export import npz as export
from learner.export import onnx
from learner.run.config import MOST_GENERATIONS
from learner.run.folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class ExportCommand(Settings):
    """Writes a learnt policy to a file, for MuJoCo and numpy or as an ONNX model; see docs/export.md."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    to: tyro.conf.Positional[Path]
    """File to write: .npz (with the task, for MuJoCo and numpy) or .onnx (the policy alone)."""
    generation: int | None = setting(None, least=0, most=MOST_GENERATIONS)
    """Generation whose mean policy is written (0: before learning); by default the last."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.to.suffix not in (".npz", ".onnx"):
            raise ConfigError(f"{self.to}: expected a name that ends in .npz or .onnx")


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = arguments.parse(ExportCommand, words, "farm export")
    policy = loaded(RunFolder.open(command.run), command.generation)
    (onnx if command.to.suffix == ".onnx" else export).write(command.to, policy)
    size = command.to.stat().st_size
    say(f"mean policy after generation {policy.generation} written to {command.to}, {size >> 10} KiB")
    return 0
