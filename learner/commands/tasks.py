"""`farm tasks`: what can be farmed, from where, with its settings."""

import contextlib
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro

from farm import plugins, settings
from farm.commands.tables import compact, wide
from farm.errors import ConfigError
from learner import config as configs

_KINDS = {"tasks": "--task", "policies": "--policy", "algorithms": "--algorithm", "backends": "--backend"}


@dataclass(frozen=True, kw_only=True)
class TasksCommand:
    """Lists tasks, policies, algorithms and backends; with a name, its settings and presets."""

    name: tyro.conf.Positional[str] = ""
    """One of them, or FILE.py:CLASS; without: all."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    command = settings.parse(TasksCommand, words, "farm tasks")
    if command.name:
        sys.stdout.write(described(command.name))
        return 0
    table = compact()
    for column in ("kind", "name", "from", "what"):
        table.add_column(column, overflow="fold")
    for kind, flag in _KINDS.items():
        for name, origin in plugins.names(kind).items():
            table.add_row(flag, name, origin, _about(kind, name))
    wide().print(table)
    sys.stdout.write("\nfarm tasks NAME shows its settings; farm new-task writes a task of your own, FILE.py:CLASS\n")
    return 0


def _about(kind: str, name: str) -> str:
    """The first line of a plug-in's docstring, or why it cannot be used."""
    try:
        target = _target(kind, name)
    except ConfigError as error:
        return str(error)
    return (target.__doc__ or "").strip().partition("\n")[0]


def _target(kind: str, name: str) -> Any:  # noqa: ANN401  a class
    with contextlib.suppress(ConfigError):
        return plugins.find(kind, name).target
    return plugins.find(kind, f"{name}:NAME").target  # one that is many


def described(name: str) -> str:
    """Where a plug-in is from, its presets and settings.

    Raises:
      ConfigError: nothing has this name.
    """
    found = []
    for kind in ("tasks", "policies", "algorithms"):
        own = name.partition(":")[0]
        if name.rpartition(":")[0].endswith(".py") or own in plugins.names(kind):
            with contextlib.suppress(ConfigError):
                found.append((kind, _plugin(kind, name)))
                break
    if not found:
        known = ", ".join(each for kind in _KINDS for each in plugins.names(kind))
        plugins.find("tasks", name)  # a file says what is wrong with it
        raise ConfigError(f"nothing is called {name!r}; there are {known}")
    [(kind, plugin)] = found
    lines = [f"{_KINDS[kind]} {plugin.wire}, {plugin.origin}", (plugin.target.__doc__ or "").strip(), ""]
    if kind == "tasks":
        for preset, values in configs.presets(plugin.name).items():
            lines.append(f"preset {preset}: " + ", ".join(f"--{k.replace('_', '-')} {v}" for k, v in values.items()))
    return "\n".join([*lines, _settings(configs.settings_class(kind, plugin.name), plugin.wire)])


def _plugin(kind: str, name: str) -> plugins.Plugin:
    with contextlib.suppress(ConfigError):
        return plugins.find(kind, name)
    return plugins.find(kind, f"{name}:NAME")


def _settings(kind: type[Any], name: str) -> str:
    """The settings as --help shows them."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.suppress(SystemExit):
        settings.parse(kind, ["--help"], name)
    return said.getvalue()
