"""`farm tasks`: lists tasks and other plug-ins, with origin and settings."""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import tyro

from farm import command_line, plugins
from farm import help as pages
from farm.commands.screen import compact, plain, wide
from farm.errors import ConfigError, printable
from farm.policies.base import Policy
from farm.settings import Settings, flag
from farm.tasks.base import Task
from learner.run import config as configs

_KINDS = {
    "tasks": "--task",
    "policies": "--policy",
    "algorithms": "--algorithm",
    "backends": "--backend",
    "loggers": "--log",
}


@dataclass(frozen=True, kw_only=True)
class TasksCommand(Settings):
    """Lists tasks, policies, algorithms, backends and loggers.

    With a name, its settings and presets.
    """

    name: tyro.conf.Positional[str] = ""
    """A name, or FILE.py:CLASS; by default list all."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = command_line.parse(TasksCommand, words, "farm tasks")
    if command.name:
        sys.stdout.write(printable(described(command.name), kept="\n"))
        return 0
    table = compact()
    for column in ("kind", "name", "from", "what"):
        table.add_column(column, overflow="fold")
    for kind, word in _KINDS.items():
        for name, origin in plugins.names(kind).items():
            table.add_row(*map(plain, (word, name, origin, _about(kind, name))))
    wide().print(table)
    sys.stdout.write(
        "\nfarm tasks NAME shows its settings; farm new-task writes a task of your own,"
        " FILE.py:CLASS\n"
    )
    return 0


def _about(kind: str, name: str) -> str:
    """The first line of a plug-in's docstring, or why it cannot be used."""
    try:
        return _doc(_plugin(kind, name)).partition("\n")[0]
    except ConfigError as error:
        return str(error)


def _doc(plugin: plugins.Plugin) -> str:
    return (plugin.target.__doc__ or "").strip()


def _plugin(kind: str, name: str) -> plugins.Plugin:
    """The plug-in with this name, or any variant of it if it has variants."""
    with contextlib.suppress(ConfigError):
        return plugins.find(kind, name)
    return plugins.find(kind, f"{name}:NAME")


def described(name: str) -> str:
    """Where a plug-in comes from, its presets and settings; a ConfigError if there is none of
    this name.
    """
    kind = _kind(name)
    plugin = _plugin(kind, name)
    lines = [f"{_KINDS[kind]} {plugin.wire}, {plugin.origin}", _doc(plugin), ""]
    if kind in ("backends", "loggers"):
        return "\n".join(lines)
    if kind == "tasks":
        for preset, values in configs.presets(plugin.name).items():
            flags = [" ".join(configs.flag_words(flag(k), v)) for k, v in values.items()]
            lines.append(f"preset {preset}: {', '.join(flags) or 'its defaults'}")
    return "\n".join([*lines, pages.table(configs.settings_class(kind, plugin.name))])


def _kind(name: str) -> str:
    if name.rpartition(":")[0].endswith(".py"):
        target = plugins.find("tasks", name).target
        return (
            "tasks"
            if issubclass(target, Task)
            else "policies"
            if issubclass(target, Policy)
            else "algorithms"
        )
    for kind in _KINDS:
        if name.partition(":")[0] in plugins.names(kind):
            return kind
    names = ", ".join(each for kind in _KINDS for each in plugins.names(kind))
    raise ConfigError(f"nothing is called {name!r}; there are {names}, and FILE.py:CLASS")
