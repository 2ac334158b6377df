"""Documents that quote the program quote what it says."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCE = "\n".join(
    path.read_text("utf-8") for name in ("farm", "learner", "workers") for path in (ROOT / name).rglob("*.py")
)
SAID = re.sub(r'"\s*\n\s*f?"', "", SOURCE)
"""With strings put together that stand on several lines."""


def quoted() -> list[str]:
    lines = (ROOT / "docs/troubleshooting.md").read_text("utf-8").splitlines()
    return [part for line in lines if line.startswith("| `") for part in re.findall(r"`([^`]+)`", line.split(" | ")[0])]


@pytest.mark.parametrize("message", quoted())
def test_messages_that_are_explained_exist(message: str) -> None:
    assert message in SAID


def test_links_lead_somewhere() -> None:
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text("utf-8")):
            assert (path.parent / target).exists(), f"{path.name}: {target}"


@pytest.mark.slow
def test_the_page_of_results_is_what_the_recorded_data_says(tmp_path: Path) -> None:
    """Made again from a copy of docs/results, it is the page that stands there, figures and all."""
    pytest.importorskip("matplotlib")
    docs = ROOT / "docs"
    shutil.copytree(docs / "results", tmp_path / "results")
    shutil.copy(docs / "results.py", tmp_path)
    for figure in (tmp_path / "results").glob("*.svg"):
        figure.unlink()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # benchmarks/ is in the checkout alone
    subprocess.run([sys.executable, tmp_path / "results.py", tmp_path / "results"], env=environment, check=True)
    assert (tmp_path / "results.md").read_text("utf-8") == (docs / "results.md").read_text("utf-8")
    assert {f.name for f in (tmp_path / "results").glob("*.svg")} == {f.name for f in (docs / "results").glob("*.svg")}
