"""docs/tutorial.md, command by command, with runs of five generations instead of many."""

import os
import re
import shlex
import shutil
import signal
from pathlib import Path

import pytest
from processes import Farm, children

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/tutorial.md").read_text("utf-8")
COMMANDS = [
    shlex.split(line, comments=True)
    for line in re.findall(r"^    ((?:farm|python) [a-z].*)$", TEXT, flags=re.M)
]
APART = [["farm", "learner", "--name", "apart"], ["farm", "worker"]]
LOOKS = "view"  # opens a window; test_compare looks into what it opens
FEW = ("--generations", "5")


@pytest.fixture
def copied(farm: Farm, monkeypatch: pytest.MonkeyPatch) -> Farm:
    """A copy of the checkout, which comes before what is installed, with the tutorial's own object
    in it.
    """
    monkeypatch.setenv("PYTHONPATH", str(farm.folder))
    for name in ("farm", "workers", "learner", "assets", "benchmarks"):
        shutil.copytree(
            ROOT / name, farm.folder / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    [(place, xml)] = re.findall(r"Save this as `([^`]+)`:\n\n```xml\n(.*?)```", TEXT, flags=re.S)
    (farm.folder / place).write_text(xml)
    return farm


@pytest.mark.slow
def test_every_command_on_one_machine(copied: Farm) -> None:
    pytest.importorskip("PIL")
    assert len(COMMANDS) >= 15
    for program, *words in COMMANDS:
        if [program, *words] in APART or LOOKS in words:
            continue
        process = (
            copied.start_python(*words)
            if program == "python"
            else copied.start(*words, *(FEW if words[0] == "run" else ()))
        )
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 0, f"{program} {shlex.join(words)}: {output}"
    first, again = copied.summary("first"), copied.summary("again")
    assert first["parameters_sha256"] == again["parameters_sha256"]
    assert {"gait.gif", "plank.gif", "compare.rrd"} <= {
        path.name for path in copied.folder.iterdir()
    }


@pytest.mark.slow
def test_the_commands_of_several_machines(copied: Farm) -> None:
    assert all(words in COMMANDS for words in APART)
    few = ("--generations", "180", "--no-record")
    [resume] = re.findall(r"`farm (learner\s+--resume\s+runs/apart)`", TEXT)
    learner, workers = (
        copied.start(*words[1:], *more) for words, more in zip(APART, (few, ()), strict=True)
    )
    copied.wait_for(lambda: len(copied.progress("apart")) >= 3)
    os.kill(children(workers.pid)[0], signal.SIGKILL)
    learner.send_signal(signal.SIGINT)
    learner.wait(60)
    assert len(copied.progress("apart")) < 180
    copied.call(*shlex.split(resume), "--no-record")
    workers.send_signal(signal.SIGTERM)
    workers.wait(60)
    copied.call("run", "--name", "whole", *few)
    assert (
        copied.summary("apart")["parameters_sha256"] == copied.summary("whole")["parameters_sha256"]
    )
