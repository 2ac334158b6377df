"""Validation with workers: the same policy for any number of them, and the traces of what
explores.
"""

from pathlib import Path

import numpy as np
import pytest
from learning import learnt
from made import POLE, pole

import farm
from farm.net.session import free_endpoint
from learner.pool.placement import Placement
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.launch import open_run

NAMES = (
    "chain",
    "policy_generation",
    "best_validation",
    "last_validation",
    "robust_return",
    "without_learning",
)

TRACED = """
    channels = (farm.Channel(name="angle", kind="scalars", shape=(1,), trace=True),)

    def measure(self, sim):
        return {"angle": sim.qpos}
"""


def test_any_number_of_workers_gives_the_same_policy(tmp_path: Path) -> None:
    file = pole(tmp_path)
    config = configure(f"{file}:Pole", generations=5, pairs=80, pilot=False)
    one, three = (learnt(config, tmp_path / str(count), count, file) for count in (1, 3))
    assert [one[name] for name in NAMES] == [three[name] for name in NAMES]
    policies = [farm.load(tmp_path / name) for name in "13"]
    assert policies[0].generation == one["policy_generation"]
    assert policies[0].mu.tobytes() == policies[1].mu.tobytes()
    lines = RunFolder.open(tmp_path / "1").progress()
    assert [line.generation for line in lines if line.validation is not None] == [1, 3, 5]


@pytest.mark.slow
def test_traces_are_of_what_explores(tmp_path: Path) -> None:
    file = pole(tmp_path, POLE + TRACED)
    config = configure(f"{file}:Pole", generations=1, pairs=2, pilot=False, traces="all")
    place = Placement(workers=1, listen=free_endpoint())
    with open_run(config, tmp_path / "r", place) as run:
        (report,) = run.learn()
    assert report.progress.validation is not None
    assert report.traces["all"].shape == (4, 4, 1)
    returns = np.cos(report.traces["all"][:, :, 0]).sum(axis=1)
    assert report.traces["best"].tobytes() == report.traces["all"][returns.argmax()].tobytes()
