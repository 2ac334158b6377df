"""Commands that draw choose how before MuJoCo is imported, which looks once."""

import ctypes.util
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from farm.commands import screen


class Closed(io.StringIO):
    """A file whose reader has gone away."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(text)


def test_a_reader_that_goes_away_is_said_to_the_command_line() -> None:
    with pytest.raises(BrokenPipeError):
        screen.Console(file=Closed()).print("text")


def test_no_other_module_has_a_console_of_its_own() -> None:
    root = Path(screen.__file__).parents[2]
    files = [*root.glob("farm/**/*.py"), *root.glob("learner/**/*.py"), *root.glob("workers/*.py")]
    having = [
        file.name
        for file in files
        if re.search(r"rich\.console(\.Console| import.*Console)", file.read_text("utf-8"))
    ]
    assert having == ["screen.py"]


@pytest.mark.parametrize("command", ["check", "replay", "chain"])
def test_a_command_that_draws_does_not_import_mujoco_before_it_has_chosen(command: str) -> None:
    code = f"import sys, learner.tools.{command}.command; sys.exit('mujoco' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("installed", "setting", "choice"),
    [
        (["OSMesa", "EGL"], None, "osmesa"),
        (["EGL"], None, "egl"),
        ([], None, None),
        (["OSMesa", "EGL"], "egl", "egl"),
    ],
)
def test_what_mujoco_draws_with_when_there_is_no_screen(
    installed: list[str], setting: str | None, choice: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "environ", {} if setting is None else {"MUJOCO_GL": setting})
    monkeypatch.setattr(
        ctypes.util, "find_library", lambda name: name if name in installed else None
    )
    screen.draw_offscreen()
    assert os.environ.get("MUJOCO_GL") == choice
