"""The help of a command, to the letter; and what a help need not import."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

import pytest
from tyro import conf

from farm import help as pages

PAGE = """\
usage: farm climb [-h] [FLAGS] HILL [HILL ...] [OUT]

Climbs hills, one after another.

Rests between them.

  HILL                    Which.
  OUT                     Where to write.

flags:
  -h, --help              Show this help and exit.
  -w, --workers INT       Who climb, in a text that is
                          longer than a line. With two
                          paragraphs. (default: 2)
  --way {ridge,valley}
  --a-name-that-is-long FLOAT|INT
                          Also long. (default: 0.5)
  --at INT                Begin here.

gear flags: What is carried.
  --rope, --no-rope       Take a rope. (on by default)
  --map                   Take a map.
  --food STR              What is eaten, repeatable.
                          (default: nuts figs)
"""


@dataclass(frozen=True)
class Gear:
    """Things. And others."""

    rope: bool = True
    """Take a rope."""
    map: bool = False
    """Take a map."""
    food: tuple[str, ...] = ("nuts", "figs")
    """What is eaten, repeatable."""


@dataclass(frozen=True, kw_only=True)
class Climb:
    """Climbs hills,
    one after another.

    Rests between them.
    """

    hills: conf.Positional[tuple[Path, ...]]
    """Which."""
    out: conf.Positional[Path | None] = None
    """Where to write."""
    workers: int = 2
    """Who climb, in a text that is longer than
    a line.

    With two paragraphs.
    """
    way: Literal["ridge", "valley"] | None = None
    a_name_that_is_long: float | int = 0.5
    """Also long."""
    start: Annotated[int | None, conf.arg(name="at", help="Begin here.")] = None
    """Not this text."""
    gear: Gear = field(default_factory=Gear)
    """What is carried."""


def test_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "56")
    assert pages.page(Climb, Climb, "farm climb", None) == PAGE


def test_a_part_of_it_says_how_much_is_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "56")
    page = pages.page(Climb, Climb(hills=()), "farm climb", ("workers",))
    assert page.endswith("(default: 2)\n\nfarm climb --help-all shows 6 more.\n")
    assert "gear" not in page
    assert "  HILL  " in page, "words without a flag are always shown"


def test_a_class_without_source_has_its_bases_texts() -> None:
    made = make_dataclass("Made", [("more", int, 3)], bases=(Gear,), frozen=True)
    page = pages.page(made, made(), "farm climb", None)
    assert "Take a rope." in page
    assert "--more INT" in page


class Colour(Enum):
    """Of a rope."""

    RED = 1
    BLUE = 2


@dataclass(frozen=True)
class Unusual:
    pair: tuple[int, float] = (1, 0.5)
    """Two."""
    names: Sequence[str] = field(default_factory=lambda: ["a", "b"])
    colour: Colour = Colour.BLUE
    sure: bool | None = None
    length: Annotated[float, conf.arg(metavar="METRES"), Colour.RED] = 2.0


def test_unusual_kinds_and_texts_that_are_not_there() -> None:
    page = pages.page(Unusual, Unusual, "farm climb", None)
    assert page.startswith("usage: farm climb [-h] [FLAGS]\n\n\nflags:\n")
    for line in (
        "--pair INT FLOAT        Two. (default: 1 0.5)",
        "--names STR             (default: a b)",
        "--colour {RED,BLUE}     (default: BLUE)",
        "--sure BOOL",
        "--length METRES         (default: 2.0)",
    ):
        assert f"  {line}\n" in page


def test_letters_that_the_output_has_not(tmp_path: Path) -> None:
    file = tmp_path / "climb.py"
    file.write_text(
        "from dataclasses import dataclass\n"
        "from farm import command_line\n"
        "@dataclass\n"
        "class Climb:\n"
        "    höhe: int = 3\n"
        "command_line.parse(Climb, ['--help'], 'climb')\n",
        "utf-8",
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, file], env=environment, capture_output=True, check=True)
    assert b"--h?he INT" in done.stdout


def test_a_table_of_settings_alone() -> None:
    table = pages.table(Gear)
    assert table.startswith("flags:\n  --rope, --no-rope       Take a rope.")
    assert "--help" not in table


def test_a_gears_own_text_if_its_field_has_none() -> None:
    made = make_dataclass("Made", [("gear", Gear, field(default_factory=Gear))], frozen=True)
    assert "\ngear flags: Things. And others.\n" in pages.page(made, made, "farm climb", None)


@pytest.mark.parametrize("command", ["run", "learner", "worker"])
def test_a_help_imports_only_what_it_needs(command: str) -> None:
    """The start of these commands is waited for by people."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "farm", command, "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "numpy" in imported, "the list is there"
    assert not imported & {"tyro", "rich", "rerun", "glfw", "scipy", "asyncio"}
