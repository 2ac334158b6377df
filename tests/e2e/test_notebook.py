"""The notebook of the examples: all of its cells run, and show what its text says."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples/first_steps.ipynb"


def text_of(outputs: list[dict[str, Any]]) -> str:
    return "".join("".join(each.get("text", "")) for each in outputs)


def run(folder: Path, *words: str | Path, **environment: str) -> str:
    process = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={"MUJOCO_GL": "osmesa", **os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=170,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def worth(text: str) -> dict[str, float]:
    return {
        name: float(value) for name, value in re.findall(r"^([a-z ]+?) +(-?[\d.]+)$", text, re.M)
    }


def test_it_is_a_notebook_without_outputs() -> None:
    """Outputs would be older than the code, and make each change of it hard to read."""
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert len(cells) > 4
    assert not any(cell.outputs or cell.execution_count for cell in cells)


@pytest.mark.slow
def test_its_cells_run_in_a_plain_process(tmp_path: Path) -> None:
    script = Path(__file__).with_name("plain_notebook.py")
    said = run(tmp_path, script, NOTEBOOK, MPLBACKEND="agg", TMPDIR=str(tmp_path))
    assert said.count("[updated Figure") == 20, "the curve is drawn again every fourth generation"
    assert "[shown Image b'GIF89a']" in said
    values = worth(said)
    assert values["the policy"] > 50.0
    assert values["nothing"] < values["a constant"] < 0.0
    [nominal] = re.findall(r"^its rollout returns ([\d.]+)$", said, re.M)
    assert float(nominal) > 50.0


@pytest.mark.slow
def test_a_kernel_of_jupyter_runs_it(tmp_path: Path) -> None:
    for package in ("ipykernel", "nbclient"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"no {package}: pip install -c constraints.txt ipykernel nbclient")
    words = ("-m", "jupyter", "execute", NOTEBOOK, "--output", tmp_path / "done.ipynb")
    run(tmp_path, *words, TMPDIR=str(tmp_path), HOME=str(tmp_path))
    cells = json.loads((tmp_path / "done.ipynb").read_text("utf-8"))["cells"]
    outputs = {cell["id"]: cell["outputs"] for cell in cells if cell["cell_type"] == "code"}
    kinds = {
        name: {kind for each in its for kind in each.get("data", ())}
        for name, its in outputs.items()
    }
    assert "image/png" in kinds["learn"]
    assert "image/gif" in kinds["film"]
    assert "image/png" in kinds["policy"]
    assert len(outputs["learn"]) == 1, "one figure, which has moved"
    assert worth(text_of(outputs["worth"]))["the policy"] > 50.0
