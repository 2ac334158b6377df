"""The benchmark of published tables: runs simulated together give the same numbers as separate
`farm run`s.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from learner.run.config import configure
from learner.run.launch import learn

TABLES = Path(__file__).parents[2] / "benchmarks" / "tables.py"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("words", "settings"),
    [
        (
            ("ars", "Hopper-v5", "--steps", "3000"),
            {
                "algorithm": "ars",
                "learning_rate_mu": 0.01,
                "initial_sigma": 0.025,
                "pairs": 8,
                "top": 4,
                "stop_after_steps": 3000,
            },
        ),
        (
            ("clipup", "Walker2d-v5", "--steps", "5000"),
            {
                "algorithm": "pgpe",
                "shaping": "ranks",
                "optimiser": "clipup",
                "pairs": 50,
                "interactions": 75000,
                "most_pairs": 400,
                "max_speed": 0.015,
                "learning_rate_mu": 0.0075,
                "initial_sigma": 0.02165,
                "sigma_rule": "capped",
                "sigma_cap": 0.2,
                "learning_rate_sigma": 0.1,
                "stop_after_steps": 5000,
                "bias": False,
            },
        ),
    ],
)
def test_the_numbers_of_runs_one_by_one(
    tmp_path: Path, words: tuple[str, ...], settings: dict[str, object]
) -> None:
    pytest.importorskip("gymnasium")
    out = tmp_path / "out.jsonl"
    command = [
        sys.executable,
        str(TABLES),
        *words,
        "--seed",
        "0",
        "3",
        "--starts",
        "2",
        "--out",
        str(out),
    ]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    _, third = (json.loads(line) for line in out.read_text().splitlines())
    assert third["seed"] == 3
    assert f"| {words[1]} | 3 |" in output
    config = configure(
        f"gym:{words[1]}",
        policy="linear",
        normalise=True,
        initial_mu=0.0,
        reward_offset=-1.0,
        seed=3,
        generations=10_000,
        **settings,
    )
    reports = list(learn(config, tmp_path / "r", workers=1))
    assert len(reports) == third["generations"] > 1
    summary = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert summary["steps"] == third["steps"]
    assert summary["parameters_sha256"].startswith(third["parameters"])
