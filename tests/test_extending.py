"""What docs/extending.md tells to add, added to a copy of the project, and learnt with."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
SECTIONS = {
    part.partition("\n")[0]: part
    for part in re.split(r"^## ", (ROOT / "docs/extending.md").read_text("utf-8"), flags=re.M)
}
_PLACE = re.compile(r"^(New file|Add to) `(.+?)`:$")
_BLOCK = re.compile(r"^```(python|diff)$")


def extended(section: str, folder: Path) -> None:
    """Copy the project and put a section's blocks into it."""
    for package in ("farm", "workers", "learner", "assets"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    path, lines = folder, iter(SECTIONS[section].splitlines())
    for line in lines:
        if place := _PLACE.match(line):
            path = folder / place[2]
            assert path.exists() == (place[1] == "Add to"), line
        elif kind := _BLOCK.match(line):
            block = [text for text in iter(lines.__next__, "```")]
            path.write_text(changed(path.read_text("utf-8"), block) if kind[1] == "diff" else "\n".join(block) + "\n")


def changed(text: str, block: list[str]) -> str:
    """Replace what a block has without + by what it has without -; it must be there once."""
    before, after = ("".join(line[1:] + "\n" for line in block if not line.startswith(other)) for other in ("+", "-"))
    assert text.count("\n" + before) == 1, before
    return text.replace("\n" + before, "\n" + after)


class Copy:
    """An extended copy, and what its commands did."""

    def __init__(self, section: str, folder: Path) -> None:
        extended(section, folder)
        self.folder = folder
        [command] = re.findall(r"^    (farm run .*)$", SECTIONS[section], re.M)
        self.words = shlex.split(command)[1:]
        self.name = self.words[self.words.index("--name") + 1]

    def farm(self, *words: str) -> str:
        command = [sys.executable, "-m", "farm", *words]  # the folder comes before what is installed
        ended = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, timeout=120, check=False)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    def learnt(self) -> dict[str, Any]:
        """The documented command's summary, after it was repeated by one worker with the same result."""
        self.farm(*self.words)
        self.farm(
            "run", "--config", f"runs/{self.name}/config.json", "--name", "again", "--workers", "1", "--no-record"
        )
        first, again = self.summary(self.name), self.summary("again")
        assert first["state"] == "finished"
        assert (self.folder / "runs" / self.name / "run.rrd").stat().st_size > 10_000
        assert first["parameters_sha256"] == again["parameters_sha256"]
        return first

    def summary(self, run: str) -> dict[str, Any]:
        return json.loads((self.folder / "runs" / run / "summary.json").read_text())

    def parameters(self) -> int:
        content = (self.folder / "runs" / self.name / "parameters").read_bytes()
        return json.loads(content.partition(b"\n")[0])["parameters"]


@pytest.fixture
def copy(request: pytest.FixtureRequest, tmp_path: Path) -> Copy:
    return Copy(request.param, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("copy", ["A state base"], indirect=True)
def test_state_base(copy: Copy) -> None:
    copy.learnt()
    assert copy.parameters() == 8 * 11


@pytest.mark.slow
@pytest.mark.parametrize("copy", ["A reward"], indirect=True)
def test_reward(copy: Copy) -> None:
    firm = copy.learnt()
    copy.farm("run", "--config", "runs/firm/config.json", "--reward", "full", "--name", "full", "--no-record")
    assert firm["best_return"] < copy.summary("full")["best_return"], "it takes something off"


@pytest.mark.slow
@pytest.mark.parametrize("copy", ["An algorithm"], indirect=True)
def test_algorithm(copy: Copy) -> None:
    summary = copy.learnt()
    assert summary["rollouts"] == 3 * 12
    config = json.loads((copy.folder / "runs/elite/config.json").read_text())
    assert config["algorithm"] == {
        "name": "cross-entropy", "rollouts": 12, "elite": 4, "initial_mu": 1.75, "initial_sigma": 0.8,
        "sigma_floor": 0.05,
    }  # fmt: skip
    assert "--elite INT" in copy.farm("run", "--algorithm", "cross-entropy", "--help")
    copy.farm("run", "--resume", "runs/elite", "--generations", "4", "--quiet")
    copy.farm("run", "--config", "runs/elite/config.json", "--name", "whole", "--no-record")
    assert copy.summary("elite")["parameters_sha256"] == copy.summary("whole")["parameters_sha256"]
    copy.farm("run", "--generations", "1", "--pairs", "6", "--name", "other", "--no-record")
    copy.farm("compare", "runs/elite", "runs/other")


@pytest.mark.slow
@pytest.mark.parametrize("copy", ["A task"], indirect=True)
def test_task(copy: Copy) -> None:
    summary = copy.learnt()
    lines = (copy.folder / "runs/upright/progress.jsonl").read_text().splitlines()
    first = json.loads(lines[0])["mean_policy_return"]
    assert first < 5, "it falls and hangs"
    assert summary["mean_policy_return"] > 15, "of 19 for 3 s upright"
    assert summary["mean_policy_success"] is None
    assert f"return {summary['mean_policy_return']:.3f}" in copy.farm("replay", "runs/upright")
    copy.farm("evaluate", "runs/upright", "--rollouts", "5")


@pytest.mark.slow
@pytest.mark.parametrize("copy", ["A worker backend"], indirect=True)
def test_backend(copy: Copy) -> None:
    summary = copy.learnt()  # repeated by the backend cpu
    assert summary["workers"] == 2
    log = (copy.folder / "runs/plain/log.txt").read_text()
    assert "failed" not in log
