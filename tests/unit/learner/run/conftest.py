"""A small task, in a file of its own."""

from pathlib import Path

import pytest
from alone import POLE


@pytest.fixture
def pole(tmp_path: Path) -> str:
    path = tmp_path / "pole.py"
    path.write_text(POLE)
    return f"{path}:Pole"
