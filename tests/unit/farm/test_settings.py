"""Command lines: one line for a mistake, and a help that says what everything is."""

import importlib
from dataclasses import dataclass, field

import pytest

from farm import __version__
from farm import settings as arguments
from farm.__main__ import COMMANDS, main
from farm.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Inner:
    """A table of settings."""

    speed: float = 0.5
    """How fast [m/s]."""
    connect: tuple[str, ...] = ()
    """Where to, repeatable."""


@dataclass(frozen=True, kw_only=True)
class Outer:
    """A command."""

    inner: Inner = field(default_factory=Inner)
    """The inner ones."""
    count: int = 3
    """How many."""
    quick: bool = False
    """Hurry."""

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ConfigError(f"count is {self.count}; expected 0 or more")


def parse(*words: str, default: Outer | None = None) -> Outer:
    return arguments.parse(Outer, words, "try", default)


def test_flags_have_no_prefix() -> None:
    assert parse() == Outer()
    assert parse("--speed", "2", "--count=7", "--quick") == Outer(inner=Inner(speed=2.0), count=7, quick=True)


def test_flags_change_a_default() -> None:
    default = Outer(inner=Inner(speed=9.0), count=1)
    assert parse("--count", "2", default=default) == Outer(inner=Inner(speed=9.0), count=2)


def test_repeated() -> None:
    assert parse("--connect", "a", "--count", "1", "--connect", "b").inner.connect == ("a", "b")
    default = Outer(inner=Inner(connect=("a",)))
    assert parse(default=default).inner.connect == ("a",)


MISTAKES = [
    (("--count", "many"), ("--count", "many")),
    (("--count",), ("missing value for argument '--count'",)),
    (("--cuont", "3"), ("--cuont", "did you mean --count")),
    (("--speed", "fast", "--quick"), ("--speed", "fast")),
    (("lonely",), ("lonely",)),
    (("--count", "-1"), ("count is -1; expected 0 or more",)),
]


@pytest.mark.parametrize(("words", "said"), MISTAKES, ids=lambda value: " ".join(value))
def test_mistakes(words: tuple[str, ...], said: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(*words)
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert not set(line) & set("│╭╮╰╯")
    for part in said:
        assert part in line
    assert "expected 0 or more" in line or line.endswith("(see try --help)")


def test_help_says_what_units_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse("--help")
    assert end.value.code in (0, None)
    said = capsys.readouterr()
    assert said.err == ""
    for part in ("usage: try", "A command.", "How fast [m/s]. (default: 0.5)", "How many. (default: 3)"):
        assert part in said.out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code in (0, None)
    said = capsys.readouterr().out
    assert f"usage: farm {command}" in said
    assert max(len(line) for line in said.splitlines() if not line.startswith("usage")) <= 100
    assert importlib.import_module(f"farm.commands.{command}").__doc__
    if command not in ("view", "certificates", "plot"):
        assert "(default: " in said
    if command in ("run", "learner"):
        for part in ("[rad]", "[N]", "of 0.1 s", "(default: 150)", "--traces {all,extremes,none}"):
            assert part in said
    if command == "worker":
        assert "[s]" in said


def test_the_front_page(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["help"]):
        assert main(words) == 0
        said = capsys.readouterr().out
        assert all(f"farm {name} " in said for name in COMMANDS)
        assert max(map(len, said.splitlines())) <= 100
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rolloutfarm {__version__}\n"
    assert main(["fly"]) == 2
    assert capsys.readouterr().err.startswith("farm: unknown command 'fly'; known are run, ")
