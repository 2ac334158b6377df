"""Settings and their checks; command lines: one line for a mistake, and help for every flag."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

import farm
from farm import command_line, plugins
from farm.__main__ import main
from farm.errors import ConfigError
from farm.plugins import COMMANDS, GROUPS
from farm.settings import Settings, from_dict, setting, to_dict


@dataclass(frozen=True, kw_only=True)
class Everything(Settings):
    """One of every kind."""

    count: int = setting(3, least=1, most=9)
    part: float = setting(0.5, above=0.0, most=1.0)
    far: float = setting(2.0, least=-1e9, below=1e9)
    positive: float = setting(1.0, above=0.0)
    limit: int | None = setting(None, least=1)
    speed: float | None = None
    either: int | float = 1
    mode: Literal["fast", "slow"] = "fast"
    note: Literal["a", "b"] | None = None
    flag: bool = False
    name: str = "n"
    names: tuple[str, ...] = ()
    anything: Any = None
    place: Path | None = None


@pytest.mark.parametrize(
    "changed",
    [
        {"count": 1},
        {"count": 9},
        {"part": 1.0},
        {"part": 5e-324},
        {"far": -1e9},
        {"limit": 1},
        {"limit": None},
        {"speed": None},
        {"speed": -2.5},
        {"mode": "slow"},
        {"note": "b"},
        {"flag": True},
        {"names": ("a", "b")},
        {"anything": object},
        {"place": Path("certs")},
    ],
    ids=str,
)
def test_values_that_are_taken(changed: dict[str, Any]) -> None:
    (name, value), config = *changed.items(), Everything(**changed)
    assert getattr(config, name) == value
    if name != "anything":
        assert from_dict(Everything, to_dict(config), "here") == config


@pytest.mark.parametrize("name", ["part", "speed", "far"])
def test_whole_numbers_become_floats_where_floats_are_wanted(name: str) -> None:
    for config in (Everything(**{name: 1}), from_dict(Everything, {name: 1}, "here")):
        assert (getattr(config, name), type(getattr(config, name))) == (1.0, float)
    assert type(Everything(either=2).either) is int
    assert type(Everything(either=2.0).either) is float


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"count": 0}, "count is 0; expected 1 to 9"),
        ({"count": 10}, "count is 10; expected 1 to 9"),
        ({"count": 1.0}, "count is 1.0; expected int"),
        ({"count": True}, "count is True; expected int"),
        ({"count": None}, "count is None; expected int"),
        ({"part": 0}, "part is 0.0; expected a positive number, at most 1"),
        ({"part": 1.1}, "part is 1.1; expected a positive number, at most 1"),
        ({"part": "1"}, "part is '1'; expected float"),
        ({"far": 1e9}, r"far is 1000000000.0; expected -1e\+09 or more, less than 1e\+09"),
        ({"positive": -1}, "positive is -1.0; expected a positive number$"),
        ({"positive": float("nan")}, "positive is nan; expected a finite number"),
        ({"positive": float("inf")}, "positive is inf; expected a finite number"),
        ({"positive": 10**400}, "positive is inf; expected a finite number"),
        ({"limit": 0}, "limit is 0; expected 1 or more"),
        ({"limit": "soon"}, "limit is 'soon'; expected int or nothing"),
        ({"limit": True}, "limit is True; expected int or nothing"),
        ({"mode": "odd"}, "unknown mode 'odd'; known are fast, slow"),
        ({"mode": 1}, "mode is 1; expected str"),
        ({"note": "c"}, "unknown note 'c'; known are a, b"),
        ({"flag": 1}, "flag is 1; expected bool"),
        ({"name": b"n"}, "name is b'n'; expected str"),
        ({"names": "ab"}, "names is 'ab'; expected tuple"),
    ],
)
def test_values_that_make_no_sense_are_named(changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=f"^{words}"):
        Everything(**changed)
    with pytest.raises(ConfigError, match=f"^over there: {words}"):
        from_dict(Everything, changed, "over there")


@pytest.mark.parametrize("value", [None, [], 3, "text"])
def test_what_is_no_table_is_refused(value: object) -> None:
    with pytest.raises(ConfigError, match="over there is .*; expected a table of settings"):
        from_dict(Everything, value, "over there")


def test_what_is_unknown_is_named_and_what_is_missing_is_the_default() -> None:
    assert from_dict(Everything, {}, "here") == Everything()
    assert from_dict(Everything, {"names": ["a"]}, "here").names == ("a",)
    with pytest.raises(ConfigError, match="here: unknown setting colour, 7; known are count, part"):
        from_dict(Everything, {"colour": 1, 7: 2}, "here")


def test_an_annotation_that_is_nowhere_is_a_clear_error() -> None:
    kind = dataclass(frozen=True, kw_only=True)(
        type("Lost", (Settings,), {"__annotations__": {"pace": "Pace"}, "pace": 1})
    )
    with pytest.raises(ConfigError, match="settings Lost: name 'Pace' is not defined"):
        kind()


# ---------------------------------------------------------------- command lines


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
    return command_line.parse(Outer, words, "try", default)


def test_flags_have_no_prefix() -> None:
    assert parse() == Outer()
    assert parse("--speed", "2", "--count=7", "--quick") == Outer(
        inner=Inner(speed=2.0), count=7, quick=True
    )


def test_flags_change_a_default() -> None:
    default = Outer(inner=Inner(speed=9.0), count=1)
    assert parse("--count", "2", default=default) == Outer(inner=Inner(speed=9.0), count=2)


def test_repeated() -> None:
    assert parse("--connect", "a", "--count", "1", "--connect", "b").inner.connect == ("a", "b")
    default = Outer(inner=Inner(connect=("a",)))
    assert parse(default=default).inner.connect == ("a",)
    assert parse("--connect", "b", "--connect=c", default=default).inner.connect == ("b", "c"), (
        "not behind the default"
    )


MISTAKES = [
    (("--count", "many"), ("--count 'many': expected a whole number (see",)),
    (("--count",), ("missing value for argument '--count' (see",)),
    (("--cuont", "3"), ("--cuont", "did you mean --count")),
    (("--speed", "fast", "--quick"), ("--speed 'fast': expected a number (see",)),
    (("lonely",), ("lonely",)),
    (("--count", "-1"), ("count is -1; expected 0 or more",)),
]


@pytest.mark.parametrize(("words", "parts"), MISTAKES, ids=lambda value: " ".join(value))
def test_mistakes(words: tuple[str, ...], parts: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as error:
        parse(*words)
    line = str(error.value)
    assert len(line.splitlines()) == 1
    assert not set(line) & set("│╭╮╰╯")
    for part in parts:
        assert part in line
    assert "expected 0 or more" in line or line.endswith("(see try --help)")


def test_help_says_what_units_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse("--help")
    assert end.value.code in (0, None)
    output = capsys.readouterr()
    assert output.err == ""
    for part in (
        "usage: try",
        "A command.",
        "How fast [m/s]. (default: 0.5)",
        "How many. (default: 3)",
    ):
        assert part in output.out


@dataclass(frozen=True, kw_only=True)
class Worked(Outer):
    """A command with short forms, and with switches that are on and off."""

    workers: int = 1
    """How many."""
    seed: tuple[int, ...] = ()
    """Which, repeatable."""
    loud: bool = True
    """Sing."""
    step_size: float = 1.0
    """How far."""


def worked(*words: str, default: Worked | None = None) -> Worked:
    return command_line.parse(Worked, words, "try", default)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--limit", "1.5"), "--limit '1.5': expected a whole number"),
        (("--speed", "fast"), "--speed 'fast': expected a number"),
    ],
)
def test_numbers_that_may_be_left_out(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=f"^{said} \\(see try --help\\)$"):
        command_line.parse(Everything, words, "try")


@pytest.mark.parametrize("default", [None, Worked(seed=(9,), workers=7)])
@pytest.mark.parametrize(
    "words", [("-w", "3", "-s", "1", "-s=2"), ("--workers", "3", "--seed=1", "--seed", "2")]
)
def test_short_forms_mean_the_long_ones(words: tuple[str, ...], default: Worked | None) -> None:
    assert worked(*words, default=default) == Worked(workers=3, seed=(1, 2))


def test_underscores_and_dashes_are_the_same_in_flags_and_kept_in_values() -> None:
    assert worked("--step_size", "2") == worked("--step-size=2") == Worked(step_size=2.0)
    inner = worked("--connect", "a_b", "--connect=--c_d").inner
    assert inner.connect == ("a_b", "--c_d")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--quick",), Worked(quick=True)),
        (("--no-loud",), Worked(loud=False)),
        (("--no_loud",), Worked(loud=False)),
        (("--loud",), Worked()),
        (("--loud=False", "--quick=true"), Worked(loud=False, quick=True)),
        (("--quick=false",), Worked()),
        (("--quick", "--quick=false"), Worked()),
        (("--no-loud", "--count", "4", "--loud"), Worked(count=4)),
    ],
)
def test_switches(words: tuple[str, ...], expected: Worked) -> None:
    assert worked(*words) == expected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--no-quick",), "--no-quick: --quick is off unless it is given: leave --no-quick out"),
        (("--no-loud=1",), r"--no-loud=1: --no-loud takes no value \(see try --help\)"),
        (("--quick=maybe",), r"--quick=maybe: expected true or false \(see try --help\)"),
    ],
)
def test_switches_that_make_no_sense(words: tuple[str, ...], said: str) -> None:
    with pytest.raises(ConfigError, match=f"^{said}$"):
        worked(*words)


def test_what_other_defaults_turn_on_may_be_turned_off() -> None:
    assert worked("--no-quick", default=Worked(quick=True)) == Worked()


def test_what_a_saved_run_has_turned_off_may_be_turned_off_again() -> None:
    """The command that began a run, with --no-X, also continues it."""
    silent = Worked(loud=False)
    assert worked("--no-loud", default=silent) == silent
    assert worked("--loud", default=silent) == Worked()
    with pytest.raises(ConfigError, match="--quick is off unless it is given"):
        worked("--no-quick", default=silent)


def shown(capsys: pytest.CaptureFixture[str], word: str, usual: tuple[str, ...] | None) -> str:
    """The help of a command of which these settings are usual."""
    with pytest.raises(SystemExit) as end:
        command_line.parse(Worked, [word], "try", Worked(workers=7), usual=usual)
    assert not end.value.code
    return capsys.readouterr().out


def test_help_has_the_usual_flags_with_their_short_forms(
    capsys: pytest.CaptureFixture[str],
) -> None:
    page = shown(capsys, "--help", ("workers", "loud"))
    assert set(re.findall(r"--[a-z][\w-]*", page)) == {
        "--help",
        "--workers",
        "--loud",
        "--no-loud",
        "--help-all",
    }
    assert "-w, --workers INT" in page
    assert "(default: 7)" in page
    assert page.endswith("\ntry --help-all shows 6 more.\n")
    assert "The inner ones." not in page
    assert page == shown(capsys, "-h", ("workers", "loud"))


def test_all_flags_are_in_the_long_help_and_in_that_of_a_command_with_few(
    capsys: pytest.CaptureFixture[str],
) -> None:
    page = shown(capsys, "--help-all", ("workers",))
    assert page == shown(capsys, "--help", None)
    for part in ("--step-size FLOAT", "--connect STR", "-s, --seed INT", "The inner ones."):
        assert part in page
    assert "--quick" in page
    assert "--no-quick" not in page
    assert re.search(r"--loud, --no-loud\s+Sing. \(on by default\)", page)
    for none in ("--help-all", "False", "True", "-w INT"):
        assert none not in page


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("view", "RUN [RUN ...]"),
        ("replay", "RUN"),
        ("runs", "[DIR]"),
        ("certificates", "{new,add,renew} DIR"),
    ],
)
def test_words_without_a_flag_are_called_by_what_they_are(
    command: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    page = capsys.readouterr().out
    assert re.search(rf"^usage: farm {command} \[-h\] \[FLAGS\] {re.escape(words)}$", page, re.M)
    assert "(default: )" not in page


@pytest.mark.parametrize("command", ["run", "learner", "sweep", "tune"])
def test_commands_that_learn_show_the_usual_flags_and_their_tasks_own(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = []
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            main([command, word])
        page = capsys.readouterr().out
        assert "\ntask flags: " in page
        assert "-config flags" not in page
        pages.append(set(re.findall(r"--[a-z][\w-]*", page)))
    few, every = pages
    assert {"--task", "--out", "--friction", "--goal-grip"} <= few
    assert "--gamma" not in few, "each task has it"
    assert {"--gamma", "--learning-rate-mu", "--traces"} <= every
    assert few - {"--help-all", "--generations"} <= every


def test_a_plugins_settings_are_shown_without_those_of_a_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["tasks", "pgpe"]) == 0
    page = capsys.readouterr().out
    assert "\nflags:\n  --pairs INT " in page
    assert "--help" not in page
    assert "usage" not in page


BUILT_IN = sorted(plugins.BUILT_IN["commands"])


def test_a_flag_that_is_there_twice_is_refused() -> None:
    @dataclass(frozen=True, kw_only=True)
    class Twice(Outer):
        """A command with a flag that its settings have as well."""

        speed: float = 1.0

    with pytest.raises(
        ConfigError, match="^--speed of try is also a setting of Inner: rename that$"
    ):
        command_line.parse(Twice, [], "try", Twice())


def test_every_command_is_on_the_front_page() -> None:
    assert sorted(COMMANDS) == BUILT_IN


@pytest.mark.parametrize("command", BUILT_IN)
def test_every_command_has_a_help(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code in (0, None)
    output = capsys.readouterr().out
    assert f"usage: farm {command}" in output
    assert max(len(line) for line in output.splitlines() if not line.startswith("usage")) <= 100
    if command in ("run", "learner"):
        for part in ("[rad]", "(default: 90)", "-t, --task STR"):
            assert part in output
    if command == "worker":
        assert "[s]" in output
        assert "--allow-file" in output


def test_the_front_page(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["help"]):
        assert main(words) == 0
        output = capsys.readouterr().out
        assert all(f"farm {name} " in output for name in COMMANDS)
        assert max(map(len, output.splitlines())) <= 120
        titles = [line for line in output.splitlines() if line.endswith(":")]
        assert titles == [f"{title}:" for title in GROUPS]
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"rolloutfarm {farm.__version__}\n"
    assert main(["fly"]) == 2
    assert capsys.readouterr().err.startswith("farm: unknown command 'fly'; farm --help")


def test_a_mistake_in_a_settings_value_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--features", "many"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_value_nested_beyond_what_can_be_shown() -> None:
    deep: list[object] = []
    for _ in range(10_000):
        deep = [deep]
    with pytest.raises(ConfigError, match="^config.json: maximum recursion depth exceeded"):
        from_dict(Everything, {"count": deep}, "config.json")


@pytest.mark.parametrize("width", [58, 80, 120])
def test_help_is_silent_on_what_need_not_be_given(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit):
        command_line.parse(Everything, ["--help"], "farm try")
    output = capsys.readouterr().out
    for none in ("(default: None)", "(default: '')", "{None}|", "{None,"):
        assert none not in output
    assert "--limit INT" in output
    assert "--no-flag" not in output
    assert "(default: 3)" in output
    assert "{a,b}" in output
    assert max(len(line) for line in output.splitlines()) <= width
