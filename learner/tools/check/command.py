"""`farm check`: finds errors of a task in seconds."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import tyro

from farm import command_line, plugins
from farm.commands.logs import say
from farm.commands.screen import draw_offscreen
from farm.settings import Settings
from farm.tasks.base import TaskConfig
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.tools.check.check import check

_VALUED: Final = ("--picture", "--backend", "--policy")


@dataclass(frozen=True, kw_only=True)
class CheckCommand(Settings):
    """Checks a task: sizes, bounds, the same bits in any batch or process, rollouts per second, a
    picture.
    """

    name: tyro.conf.Positional[str]
    """The task: a name, gym:NAME, or FILE.py:CLASS."""
    picture: Path | None = None
    """Where to write the picture of the start, NAME.png; by default the task's name."""
    backend: str = "cpu"
    """Backend that is compared with cpu, in returns and rollouts per second: a name, or
    FILE.py:CLASS.
    """
    policy: str = ""
    """Policy that acts: a name, or FILE.py:CLASS; by default that of a run of the task."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Settings of the task."""


def main(words: Sequence[str]) -> int:
    """Run the command."""
    draw_offscreen()  # before anything imports MuJoCo
    command, config = _parsed(words)
    name = plugins.find("tasks", config.task).target.__name__
    picture = command.picture or Path(f"{name.lower()}.png")
    check(config, picture=picture, backend=command.backend, said=say)
    return 0


def _parsed(words: Sequence[str]) -> tuple[CheckCommand, RunConfig]:
    """The command, and a run of its task."""
    name = task_name(words)
    config = None if name is None else configs.configure(plugins.find("tasks", name).name)
    default = CheckCommand(name=name, task=config.task_config) if name and config else None
    command = command_line.parse(CheckCommand, words, "farm check", default)
    assert config is not None
    if command.policy:
        config = configs.configure(config.task, policy=command.policy)
    return command, replace(config, task_config=command.task)


def task_name(words: Sequence[str]) -> str | None:
    """The task among the words: the first that looks like one, else the first that is no flag or
    value of one.
    """
    loose = [
        word for flag, word in pairwise(("", *words)) if word[:1] != "-" and flag not in _VALUED
    ]
    tasks = [word for word in loose if ":" in word or word in plugins.names("tasks")]
    return next(iter(tasks or loose), None)
