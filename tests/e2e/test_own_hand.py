"""docs/own-hand.md, command by command, with runs of three generations instead of many."""

import re
import shlex
from pathlib import Path

import pytest
from processes import Farm

pytestmark = pytest.mark.slow

TEXT = (Path(__file__).parents[2] / "docs/own-hand.md").read_text("utf-8")
FILES = re.findall(r"Save this as `([^`]+)`[^\n]*:\n\n```\w+\n(.*?)```", TEXT, flags=re.S)
COMMANDS = [shlex.split(line, comments=True) for line in re.findall(r"^    (farm .*)$", TEXT, re.M)]
LOOKS = "view"  # opens a window
FEW = ("--generations", "3")


@pytest.fixture
def folder(farm: Farm) -> Farm:
    """A reader's folder with the page's two files."""
    assert [name for name, _ in FILES] == ["hand.xml", "hand.py"]
    for name, text in FILES:
        (farm.folder / name).write_text(text)
    return farm


@pytest.mark.timeout(300)  # nine programs, two minutes alone on a slow machine
def test_every_command(folder: Farm) -> None:
    pytest.importorskip("PIL")
    pytest.importorskip("onnx")
    assert len(COMMANDS) == 10
    for _, *words in COMMANDS:
        if words[0] != LOOKS:
            folder.call(*words, *(FEW if words[0] == "run" else ()))
    made = {path.name for path in folder.folder.iterdir()}
    assert {"lift.png", "hand.gif", "worst.gif", "hand.onnx"} <= made


@pytest.mark.timeout(900)
def test_the_hand_learns_what_the_page_says(folder: Farm) -> None:
    [words] = [words for _, *words in COMMANDS if words[-1] == "hand" and words[0] == "run"]
    folder.call(*words, "--no-record", timeout=600)
    summary = folder.summary("hand")
    assert f"hash {summary['parameters_sha256'][:16]}" in TEXT
    assert f"the policy returns {summary['robust_return']:.4g} (success 100%" in TEXT
