"""Benchmarks' scripts run, and print the rows that they promise; how fast anything is, no test says."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "rows"),
    [
        ("grips.py", 11),
        ("environments.py --rollouts 2 --steps 3 --repeats 1", 10),
        ("timeline.py --pairs 2 --generations 9", 6),
        ("scaling.py --workers 2,5 --pair 0.001 --seconds 0.5", 5),
    ],
    ids=lambda value: str(value).partition(".")[0],
)
def test_they_print_their_tables(words: str, rows: int) -> None:
    pytest.importorskip("gymnasium")
    name, *arguments = words.split()
    done = subprocess.run([sys.executable, FOLDER / name, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = [line.strip() for line in done.stdout.splitlines() if line.startswith("|")]
    heads = sum(line.startswith("|--") for line in lines)
    assert len(lines) - 2 * heads == rows, done.stdout
    assert all(line.count("|") >= 3 for line in lines)
