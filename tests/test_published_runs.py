"""The runs that are published in docs/results/runs are what this code learns, to the last bit."""

import json
import re
import shutil
from pathlib import Path

import pytest

from farm.__main__ import main

ROOT = Path(__file__).parent.parent
TASK = ["--allow-file", "docs/results/runs/pendulum.py"]
RUNS = sorted(path.parent for path in (ROOT / "docs/results/runs").glob("*/config.json"))


@pytest.fixture(autouse=True)
def _at_the_top(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)  # as the page says


SOME = [
    pytest.param(run, marks=[] if run.name == "swing" else [pytest.mark.slow], id=run.name)
    for run in RUNS
]


@pytest.mark.parametrize("run", SOME)
def test_a_share_of_each_is_repeated(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(run), "--share", "0.02", *TASK]) == 0
    assert "verified to the bit: 2 of " in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_each_is_learnt_again(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(run), "--all", "--workers", "2", *TASK]) == 0
    assert "and the results" in capsys.readouterr().out


def test_they_are_the_ones_that_the_pages_speak_of() -> None:
    page = (ROOT / "docs/results/runs/README.md").read_text("utf-8")
    assert sorted(set(re.findall(r"docs/results/runs/(\w+) ", page))) == [run.name for run in RUNS]
    summary = json.loads((ROOT / "docs/results/runs/gait/summary.json").read_text("utf-8"))
    [parameters] = re.findall(r"hash (\w{16})  in", (ROOT / "README.md").read_text("utf-8"))
    assert summary["parameters_sha256"].startswith(parameters)
    assert sum(path.stat().st_size for run in RUNS for path in run.iterdir()) < 400_000


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_an_altered_copy_is_noticed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(run, tmp_path / "r")
    lines = (run / "progress.jsonl").read_text().splitlines(keepends=True)
    lines[40] = re.sub(
        r'"best": -?\d+\.\d',
        lambda match: match[0][:-1] + str((int(match[0][-1]) + 1) % 10),
        lines[40],
    )
    (tmp_path / "r/progress.jsonl").write_text("".join(lines))
    assert main(["verify", str(tmp_path / "r"), *TASK]) == 1
    assert "generation 41 differs" in capsys.readouterr().err
