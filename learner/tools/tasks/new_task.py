"""`farm new-task`: writes a task of your own to start from."""

import keyword
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final

import tyro

from farm import command_line
from farm.commands.logs import say
from farm.errors import ConfigError, writing
from farm.settings import Settings
from farm.targets import typed

TEMPLATE = "task_template.py.txt"
"""The template, in this package; `Pendulum` is replaced by the name."""

_USED: Final = ("Task",)  # of the template
_IMPORTED: Final = ("farm", "learner", "msgpack", "mujoco", "numpy", "rerun", "workers", "zenoh")


@dataclass(frozen=True, kw_only=True)
class NewTaskCommand(Settings):
    """Writes NAME.py, a task of 31 lines that runs; change it into your own."""

    name: tyro.conf.Positional[str]
    """Name of the task: letters, digits and _; its class gets this name, too."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    name = command_line.parse(NewTaskCommand, words, "farm new-task").name.replace("-", "_")
    path, inside = Path(f"{name}.py"), "".join(part.capitalize() for part in name.split("_"))
    if not (name.isidentifier() and name.isascii()) or not inside.isidentifier():
        raise ConfigError(
            f"{name!r} is no name of a task; expected letters, digits and _, a letter first"
        )
    if keyword.iskeyword(inside) or inside in _USED:
        raise ConfigError(f"{name!r} is no name of a task: a class cannot be called {inside}")
    if name in sys.stdlib_module_names or name in _IMPORTED:
        raise ConfigError(
            f"{path} would hide the module {name} from programs in this folder: take another name"
        )
    text = (files("learner.tools.tasks") / TEMPLATE).read_text("utf-8").replace("Pendulum", inside)
    if path.exists():
        raise ConfigError(f"{path} exists and is not overwritten: take another name")
    with writing(path, ConfigError), path.open("x", encoding="utf-8") as file:
        file.write(text)
    task = typed(f"{path}:{inside}")
    say(f"written to {path}; next:", f"  farm check {task}", f"  farm run --task {task}")
    return 0
