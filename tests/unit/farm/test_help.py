"""The help of a command, to the letter; and what a help need not import."""

import subprocess
import sys
from dataclasses import dataclass, field, make_dataclass
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
