"""Environments of Gymnasium learnt by real processes."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import Farm, children
from recordings import content, generations, read, rows

from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import configure
from learner.run.launch import open_run

pytestmark = pytest.mark.slow

TASK = ("--task", "gym:Pusher-v5", "--steps", "20")
PHYSICS = 20 * 5  # physics steps of a rollout
SMALL = (*TASK, "--pairs", "6", "--generations", "6")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Farm:
    """An undisturbed run of two workers, recorded."""
    farm = Farm(tmp_path_factory.mktemp("gym"))
    farm.call("run", "--name", "r", *SMALL)
    return farm


def same(summary: dict[str, Any], learnt: Farm) -> None:
    figures = ("parameters_sha256", "mean_policy_return", "robust_return", "best_return")
    assert [summary[name] for name in figures] == [learnt.summary("r")[name] for name in figures]


def test_one_worker_learns_the_same(farm: Farm, learnt: Farm) -> None:
    farm.call("run", "--name", "r", "--workers", "1", "--no-record", *SMALL)
    same(farm.summary("r"), learnt)


@pytest.mark.parametrize("seconds", [1e-6, 10.0])
def test_any_size_of_chunk_learns_the_same(tmp_path: Path, learnt: Farm, seconds: float) -> None:
    config = configure("gym:Pusher-v5", steps=20, pairs=6, generations=6)
    chunks = SchedulerConfig(chunk_seconds=seconds)
    place = Placement(workers=2, listen=free_endpoint(), scheduler=chunks)
    with open_run(config, tmp_path / "r", place) as run:
        for _ in run.learn():
            pass
    same(run.summary, learnt)


def test_a_worker_killed_and_a_run_resumed_learn_the_same(farm: Farm, learnt: Farm) -> None:
    process = farm.start("run", "--name", "r", "--no-record", *SMALL)
    farm.wait_for(lambda: len(farm.progress("r")) >= 1)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    farm.wait_for(lambda: len(farm.progress("r")) >= 2)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130, output
    farm.call("run", "--resume", "runs/r", "--no-record")
    same(farm.summary("r"), learnt)


def test_success_is_empty_everywhere(learnt: Farm) -> None:
    summary = learnt.summary("r")
    assert [
        summary[name] for name in ("mean_policy_success", "success_rate", "robust_success_rate")
    ] == [None] * 3
    assert {line["mean_policy_success"] for line in learnt.progress("r")} == {None}
    assert {line["success_rate"] for line in learnt.progress("r")} == {None}
    [row] = json.loads(learnt.call("runs", "--json"))
    assert row["mean_policy_success"] is None
    assert "success" not in learnt.call(
        "run", "--name", "said", "--no-record", *TASK, "--generations", "1"
    )
    assert "succeed" not in learnt.call("replay", "runs/r", "--to", "again.rrd")
    assert learnt.call("runs")


def test_evaluate_starts_from_other_seeds(learnt: Farm) -> None:
    figures = json.loads(learnt.call("evaluate", "runs/r", "--json"))
    summary = learnt.summary("r")
    assert figures["perturbed"]["return_mean"] == summary["robust_return"]
    assert figures["nominal"]["return_mean"] == summary["mean_policy_return"]
    assert figures["perturbed"]["return_min"] < figures["perturbed"]["return_max"]
    assert figures["perturbed"]["success_rate"] is None
    assert "success" not in learnt.call("evaluate", "runs/r", "--rollouts", "2")


def test_the_recording_shows_the_scene(learnt: Farm) -> None:
    path = learnt.folder / "runs" / "r" / "run.rrd"
    assert generations(path) == [1, 2, 3, 4, 5, 6]
    batches = read(path)
    assert not [e for e in batches if e.startswith(("/tactile", "/contacts", "/joints"))]
    assert "/learning/success" not in {entity for entity, *_ in content(path)}
    values = rows(batches["/learning/return"], "scalars")
    progress = learnt.progress("r")
    assert [values[p["generation"]][0] for p in progress] == [p["return_mean"] for p in progress]
    object_moves = [
        key for key in content(path) if key[0] == "/world/object" and key[1].endswith("translation")
    ]
    assert len(object_moves) == 6 * 21 + PHYSICS + 1, (
        "six means at control rate, and the last policy at physics rate"
    )
    assert {"/world/world", "/world/goal", "/actions", "/reward/terms"} <= set(batches)
    rewards = [
        value for key, value in content(path).items() if key[0] == "/reward/terms" and key[2] == 5
    ]  # before the 6th update
    assert np.sum(rewards) == pytest.approx(progress[-1]["mean_policy_return"], rel=1e-6)
    replays = read(learnt.folder / "runs" / "r" / "replay.rrd")
    assert "/world/object" in replays


def test_workers_and_a_recorder_elsewhere(farm: Farm, learnt: Farm) -> None:
    endpoint = free_endpoint()
    learner = farm.start("learner", "--listen", endpoint, "--name", "r", *SMALL)
    recorder = farm.start("record", "--connect", endpoint, "--run", "r")
    farm.start("worker", "--connect", endpoint, "--workers", "1")
    for process in (learner, recorder):
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 0, output
    same(farm.summary("r"), learnt)
    here = content(farm.folder / "runs/r/run.rrd")
    remote = content(farm.folder / "recordings/r/run.rrd")
    curves = [
        key for key in here if key[0].startswith(("/world", "/reward", "/actions", "/learning"))
    ]
    assert curves
    # Nan where there is no baseline
    assert all(repr(here[key]) == repr(remote[key]) for key in curves)
