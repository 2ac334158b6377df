"""A policy's scale: the search works on z, and the policy has scale z."""

from pathlib import Path
from typing import Any

import pytest
from alone import POLE, Alone

from farm.errors import ConfigError
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.tools.replay.loaded import load

POLICY = """
import numpy as np
import farm

class Own(farm.Policy):
    size = 3

    def start(self, rng):
        return np.array([0.5, -1.0, 8.0]){divided}

    def prepare(self, theta):
        return theta{times}

    def act(self, prepared, x):
        return (prepared[:, :2] * x).sum(axis=1, keepdims=True) + prepared[:, 2:]
"""
SCALE = "np.array([0.25, 1.0, 4.0])"  # powers of two, which round nothing
SETTINGS: tuple[dict[str, Any], ...] = (
    {"optimiser": "clipup"},
    {"optimiser": "adam", "sigma_rule": "capped"},
    {"algorithm": "snes"},
    {"algorithm": "ars"},
    {"algorithm": "es"},
    {"algorithm": "cma-es", "population": 6},
    {"algorithm": "sep-cma", "population": 6},
)


def learnt(folder: Path, name: str, policy: str, **settings: Any) -> tuple[bytes, bytes]:
    """The mean and sigma of a run with this policy."""
    (folder / "pole.py").write_text(POLE)
    (folder / f"{name}.py").write_text(policy)
    config = configure(
        f"{folder}/pole.py:Pole",
        policy=f"{folder}/{name}.py:Own",
        initial_mu=0.0,
        initial_sigma=0.3,
        **settings,
    )
    problem, at = setup.start(config, name)
    learner = Learner(problem, RunFolder.create(folder / name, config), at)
    for _ in learner.learn(Alone(problem)):  # type: ignore[arg-type]
        pass
    at = checkpoints.load(folder / name / "checkpoint")
    return at.state["mu"].tobytes(), at.state["sigma"].tobytes()


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_every_algorithm_searches_in_units_of_the_scale(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    plain = POLICY.format(divided="", times="")
    scaled = learnt(tmp_path, "scaled", plain + f"\n    scale = {SCALE}\n", **settings)
    manual = learnt(
        tmp_path, "own", POLICY.format(divided=f" / {SCALE}", times=f" * {SCALE}"), **settings
    )
    assert scaled == manual != learnt(tmp_path, "plain", plain, **settings)
    policy = load(tmp_path / "scaled")
    assert policy.parameters.tolist() == (policy.mu * [0.25, 1.0, 4.0]).tolist()
    assert load(tmp_path / "scaled", 0).parameters.tolist() == [0.5, -1.0, 8.0]
    assert policy.rollout().trajectory.value == load(tmp_path / "own").rollout().trajectory.value


def test_a_scale_of_ones_is_none(tmp_path: Path) -> None:
    plain = POLICY.format(divided="", times="")
    assert learnt(tmp_path, "ones", plain + "\n    scale = np.ones(3)\n") == learnt(
        tmp_path, "plain", plain
    )
    policy = load(tmp_path / "plain")
    assert policy.parameters.tolist() == policy.mu.tolist()


@pytest.mark.parametrize(
    ("scale", "reason"),
    [
        (
            "np.ones(2)",
            r"gave an array of float64 \(2,\); expected 3 finite numbers of float64, or None",
        ),
        (
            "np.array([1.0, np.nan, 1.0])",
            r"gave an array of float64 \(3,\); expected 3 finite numbers",
        ),
        ("2.0", "gave a float; expected 3 finite numbers"),
        ("np.array([1.0, 0.0, 2.0])", "has 0.0; expected positive numbers"),
        ("np.array([1.0, -3.0, 2.0])", "has -3.0; expected positive numbers"),
    ],
)
def test_a_scale_that_cannot_be_is_named(scale: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"^scale of own.py:Own {reason}"):
        learnt(tmp_path, "own", POLICY.format(divided="", times="") + f"\n    scale = {scale}\n")
