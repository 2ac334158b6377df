"""`farm tune`, with real learners on shared workers: the same race for any workers, deaths and
interruptions.
"""

import json
import os
import shlex
import signal
from pathlib import Path
from typing import Any

import pytest
from processes import Farm, children

import farm as rolloutfarm

WORDS = (
    "tune",
    "mine.py:Mine",
    "--rollouts",
    "1200",
    "--only",
    "linear-ars",
    "--only",
    "linear-es",
    "--only",
    "direct-snes",
    "--no-record",
)


def race(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "race.json").read_text())


def hashes(folder: Path) -> dict[str, str]:
    return {
        path.parent.name: json.loads(path.read_text())["parameters_sha256"]
        for path in folder.glob("*/summary.json")
    }


@pytest.mark.slow
def test_the_same_race_on_one_worker_on_three_that_die_and_after_an_interruption(
    farm: Farm,
) -> None:
    farm.call("new-task", "mine")
    output = farm.call(*WORDS, "--out", "one", "--workers", "1")
    first, digests = race(farm.folder / "one"), hashes(farm.folder / "one")
    assert [len(scores) for scores in first["scores"]] == [3, 2, 1]
    assert len(digests) == 3
    [command] = [line for line in output.splitlines() if "farm run" in line]
    [winner] = first["scores"][-1]

    process = farm.start(*WORDS, "--out", "again", "--workers", "3")
    resumed = farm.folder / f"again/{winner}-s0"
    farm.wait_for(
        lambda: (farm.folder / "again/race.json").exists() and race(farm.folder / "again")["scores"]
    )
    before = len((resumed / "progress.jsonl").read_text().splitlines())
    workers = [
        pid
        for pid in children(process.pid)
        if b"\0workers\0" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    os.kill(workers[0], signal.SIGKILL)
    farm.wait_for(lambda: len((resumed / "progress.jsonl").read_text().splitlines()) > before + 1)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130, out
    assert "the same command continues" in out
    assert len(race(farm.folder / "again")["scores"]) == 1
    farm.call(*WORDS, "--out", "again", "--workers", "2")
    assert race(farm.folder / "again") == first
    assert hashes(farm.folder / "again") == digests

    words = shlex.split(command.partition("farm run")[2])
    farm.call("run", *words, "--name", "alone", "--no-record", "--workers", "2")
    assert farm.summary("alone")["parameters_sha256"] == digests[f"{winner}-s0"], (
        "the race changes no number"
    )
    assert farm.summary("alone")["robust_return"] == first["scores"][-1][winner], (
        "of the averaged policy"
    )
    result = (farm.folder / "one/result.md").read_text()
    assert result == (farm.folder / "again/result.md").read_text().replace("again/", "one/")
    evaluation = farm.call("evaluate", f"one/{winner}-s0", "--seed", "1")
    assert "return" in evaluation
    assert "here it is 2500" in farm.call(
        *WORDS[:2], "--rollouts", "2500", *WORDS[4:], "--out", "one", status=2
    )


@pytest.mark.slow
def test_the_winner_is_a_run_like_any_other(farm: Farm) -> None:
    farm.call("new-task", "mine")
    words = (
        "tune",
        "mine.py:Mine",
        "--rollouts",
        "600",
        "--only",
        "linear-ars",
        "--only",
        "linear-es",
    )
    output = farm.call(*words, "--workers", "2")
    assert "look at it with: farm view tunes/mine-Mine-s0/linear-" in output
    [winner] = race(farm.folder / "tunes/mine-Mine-s0")["scores"][-1]
    folder = f"tunes/mine-Mine-s0/{winner}-s0"
    assert (farm.folder / folder / "run.rrd").stat().st_size > 10_000
    assert (farm.folder / "tunes/mine-Mine-s0/figure.svg").exists()
    farm.call("export", folder, "policy.npz")
    assert "after 40 generations" in farm.call(
        "run", "--resume", folder, "--generations", "40", "--workers", "1"
    )


@pytest.mark.slow
def test_a_race_from_python(farm: Farm) -> None:
    farm.call("new-task", "mine")
    config = rolloutfarm.RunConfig(task=f"{farm.folder}/mine.py:Mine")
    entries = {
        "a": {"policy": "linear", "algorithm": "es", "pairs": 4},
        "b": {"policy": "constant"},
    }
    done = rolloutfarm.tune(config, farm.folder / "race", rollouts=400, entries=entries, workers=1)
    assert [len(scores) for scores in done.scores] == [2, 1]
    assert (done.folder(done.winner) / "checkpoint").exists()
    again = rolloutfarm.tune(config, farm.folder / "race", rollouts=400, entries=entries, workers=2)
    assert again.scores == done.scores
