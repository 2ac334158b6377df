"""`farm check`: which word is the task, and settings with the same name as a flag of the command."""

from pathlib import Path

import pytest

from farm.__main__ import main
from learner.commands import check

TASK = """import farm
from dataclasses import dataclass

class Mine(farm.Task):
    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        speed: float = 1.0
"""


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["--picture", "x.png", "mine.py:Mine"], "mine.py:Mine"),
        (["--torque", "2", "finger-gait", "--picture", "x.png"], "finger-gait"),
        (["nonsense", "--steps", "3"], "nonsense"),
        (["--steps=3"], None),
    ],
)
def test_the_task_may_stand_anywhere(words: list[str], name: str | None) -> None:
    assert check._name(words) == name


def test_a_setting_that_a_command_has_as_well_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.py"
    path.write_text(TASK)
    assert main(["check", f"{path}:Mine"]) == 2
    assert capsys.readouterr().err == "farm: --speed of farm replay is also a setting of Mine.Config: rename that\n"
