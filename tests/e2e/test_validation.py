"""Validation in processes: a killed learner, other numbers of workers, and the commands that take
the run's policy.
"""

import signal
from pathlib import Path

import pytest
from made import pole
from processes import Farm

pytestmark = pytest.mark.slow

NAMES = (
    "parameters_sha256",
    "chain",
    "policy_generation",
    "best_validation",
    "last_validation",
    "robust_return",
    "without_learning",
)


def test_a_killed_learner_with_other_workers_delivers_the_same_policy(
    farm: Farm, tmp_path: Path
) -> None:
    task = f"{pole(tmp_path)}:Pole"
    words = (
        "run",
        "--task",
        task,
        "--no-pilot",
        "--pairs",
        "80",
        "--generations",
        "12",
        "--no-record",
        "--name",
    )
    output = farm.call(*words, "whole", "--workers", "1")
    assert "validation" in output
    assert "doing nothing" in output
    process = farm.start(*words, "killed", "--workers", "3")
    farm.wait_for(lambda: len(farm.progress("killed")) >= 4)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert len(farm.progress("killed")) < 12
    farm.call("run", "--resume", "runs/killed", "--workers", "2", "--no-record")
    whole, killed = farm.summary("whole"), farm.summary("killed")
    assert [whole[name] for name in NAMES] == [killed[name] for name in NAMES]
    assert whole["without_learning"] is not None
    figures = farm.call("evaluate", "runs/killed", "--json")
    assert f'"generation": {whole["policy_generation"]},' in figures
    assert '"generation": 12,' in farm.call("evaluate", "runs/killed", "--json", "--last")
    assert "verified to the bit: 12 of 12 generations" in farm.call(
        "verify", "runs/killed", "--all", "--workers", "1"
    )
    assert "each says which policy" in farm.call(
        "export", "runs/killed", "p.npz", "--last", "--generation", "3", status=2
    )
