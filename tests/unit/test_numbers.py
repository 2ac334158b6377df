"""Every number that a command takes is checked: nan, infinite, negative and absurd ones get one
line.
"""

import dataclasses
import importlib
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest

from farm import plugins
from farm.__main__ import main
from farm.errors import ConfigError
from farm.settings import Settings
from farm.tasks.base import TaskConfig
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.folder import RunFolder

WORDS = {
    "replay": ("RUN",),
    "play": ("RUN",),
    "evaluate": ("RUN",),
    "stress": ("RUN",),
    "verify": ("RUN",),
    "export": ("RUN", "p.npz"),
    "chain": ("RUN",),
    "certificates": ("new", "certs"),
}
"""What commands need besides the number."""


def command(name: str) -> type[Any]:
    """The dataclass of a command's options: the only one in its module that is called a command."""
    module = importlib.import_module(plugins.find("commands", name).target.__module__)
    [found] = [
        value
        for key, value in vars(module).items()
        if key.endswith("Command") and value.__module__ == module.__name__
    ]
    return found


def numbers(kind: type[Any]) -> Iterator[tuple[str, type]]:
    """The numeric options of a dataclass, and of those inside it.

    Those of runs and tasks have a test of their own.
    """
    hints = get_type_hints(kind)
    for each in dataclasses.fields(kind):
        hint = hints[each.name]
        kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        if dataclasses.is_dataclass(hint):
            if hint not in (RunConfig, TaskConfig):
                yield from numbers(hint)  # type: ignore[arg-type]
        elif number := next((one for one in kinds if one in (int, float)), None):
            yield each.name, number


OPTIONS = [(name, *option) for name in plugins.COMMANDS for option in numbers(command(name))]


@pytest.mark.parametrize("name", plugins.COMMANDS)
def test_all_options_of_commands_are_settings(name: str) -> None:
    def all_of(kind: type[Any]) -> Iterator[type[Any]]:
        yield kind
        for hint in get_type_hints(kind).values():
            if dataclasses.is_dataclass(hint):
                yield from all_of(hint)  # type: ignore[arg-type]

    assert [kind.__name__ for kind in all_of(command(name)) if not issubclass(kind, Settings)] == []


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return RunFolder.create(tmp_path_factory.mktemp("runs") / "r", RunConfig()).path


def test_there_are_numbers_to_check() -> None:
    assert {
        ("status", "timeout", float),
        ("worker", "timeout", float),
        ("learner", "audit", float),
    } <= set(OPTIONS)
    assert len(SETTINGS) > 20


@pytest.mark.parametrize("name", sorted({name for name, *_ in OPTIONS}))
def test_a_number_that_makes_no_sense_gets_one_line(
    name: str,
    run: Path,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [str(run) if word == "RUN" else word for word in WORDS.get(name, ())]
    for flag in (option.replace("_", "-") for command, option, _ in OPTIONS if command == name):
        for value in ("nan", "inf", "-1", "1e30", str(10**30)):
            given = f"--{flag}={value}"
            assert main([name, *words, given]) == 2, given
            said = capsys.readouterr()
            assert len(said.err.splitlines()) == 1, given
            assert flag in said.err, f"{given}: the line names the option"
            assert said.out == "", given
    assert list(tmp_path.iterdir()) == []


def parts() -> Iterator[tuple[str, Any]]:
    """The run's own settings, and those of every built-in task, policy and algorithm."""
    yield "run", RunConfig()
    for kind in configs.PARTS.values():
        for name in plugins.BUILT_IN[kind]:
            if name != "gym":
                yield name, configs.settings_class(kind, name)()


SETTINGS = [
    (name, made, option)
    for name, made in parts()
    for option, kind in numbers(type(made))
    if kind is float
]


@pytest.mark.parametrize("name", sorted({name for name, *_ in SETTINGS}))
def test_settings_of_a_run_are_finite(name: str) -> None:
    for made, option in ((made, option) for part, made, option in SETTINGS if part == name):
        for value in (float("nan"), float("inf"), -float("inf")):
            assert option.replace("_", "-") in refusal(made, option, value), f"{option} is {value}"


def refusal(made: Any, option: str, value: float) -> str:
    """What is said of settings with that value, nothing if they are taken."""
    try:
        dataclasses.replace(made, **{option: value})
    except ConfigError as error:
        return str(error)
    return ""
