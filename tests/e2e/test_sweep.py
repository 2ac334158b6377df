"""`farm sweep`, with real learners side by side on shared workers."""

import csv
import json
import signal
from pathlib import Path

import pytest
from processes import Farm, children

from farm.net.session import free_endpoint

SHORT = (
    "sweep",
    "--vary",
    "initial_sigma=0.4,0.8",
    "--seeds",
    "0-1",
    "--pairs",
    "6",
    "--generations",
    "6",
)
"""Four runs."""


def hashes(folder: Path) -> dict[str, str]:
    return {
        path.parent.name: json.loads(path.read_text())["parameters_sha256"]
        for path in folder.glob("*/summary.json")
    }


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_to_the_numbers_of_runs_one_after_another(farm: Farm) -> None:
    process = farm.start(*SHORT, "--out", "s", "--workers", "2", "--parallel", "2")
    farm.wait_for(lambda: list(farm.folder.glob("s/*/progress.jsonl")))
    started = children(process.pid)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "the same command continues with them" in output
    assert "interrupted: " not in output, "the signal of its own learners is no reason"
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)
    output = farm.call(*SHORT, "--out", "s", "--workers", "2")
    assert "(0 left)" in output
    assert "mean ± standard deviation over seeds" in output
    digests = hashes(farm.folder / "s")
    with (farm.folder / "s" / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["parameters_sha256"] for row in rows} == set(digests.values())
    assert [row["state"] for row in rows] == ["finished"] * 4
    for row in rows:
        name = f"initial_sigma-{row['initial_sigma']}-s{row['seed']}"
        flags = (
            "--initial-sigma",
            row["initial_sigma"],
            "--seed",
            row["seed"],
            "--pairs",
            "6",
            "--generations",
            "6",
        )
        farm.call("run", *flags, "--name", name, "--no-record", "--workers", "1")
        assert farm.summary(name)["parameters_sha256"] == digests[name]
    before = {path: path.stat().st_mtime_ns for path in (farm.folder / "s").glob("*/checkpoint")}
    assert "0 of 4 runs to do" in farm.call(*SHORT, "--out", "s")
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    assert "was started with --pairs 6; here it is 7" in farm.call(
        *SHORT, "--pairs", "7", "--out", "s", status=2
    )


@pytest.mark.slow
def test_a_sweep_of_a_task_in_a_file_on_workers_of_its_own_and_of_a_farm(farm: Farm) -> None:
    farm.call("new-task", "mine")
    words = (
        "sweep",
        "--task",
        "mine.py:Mine",
        "--seeds",
        "0,5",
        "--pairs",
        "3",
        "--generations",
        "2",
    )
    assert "2 of 2" in farm.call(*words, "--out", "own", "--workers", "1")
    endpoint = free_endpoint()
    farm.start_router(endpoint)
    farm.start("worker", "--connect", endpoint, "--workers", "1", "--allow-file", "mine.py")
    farm.call(*words, "--out", "farm", "--connect", endpoint)
    assert hashes(farm.folder / "own") == hashes(farm.folder / "farm")
    assert len(hashes(farm.folder / "own")) == 2
