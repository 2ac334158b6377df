"""Loading a run's policy after the file of its task has changed."""

import logging
from pathlib import Path

import numpy as np
import pytest

import farm
from learner import checkpoint as checkpoints
from learner.config import RunConfig
from learner.run_folder import RunFolder
from learner.setup import start

TASK = """import farm

class Mine(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>'''
    steps = 3

    def reward(self, sim, action):
        return 1.0 + sim.qpos[:, 0]
"""


def test_changed_code_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "mine.py"
    path.write_text(TASK)
    config = RunConfig(task=f"{path}:Mine")
    folder = RunFolder.create(tmp_path / "run", config)
    checkpoints.save(folder.checkpoint, start(config, "run")[1])
    with caplog.at_level(logging.WARNING):
        before = farm.load(folder.path).rollout().rollouts.returns
        assert not caplog.messages
        path.write_text(TASK.replace("1.0", "2.0"))
        after = farm.load(folder.path).rollout().rollouts.returns
    np.testing.assert_allclose(after - before, 3.0)
    assert [m.partition(": ")[2] for m in caplog.messages] == [
        "the code of its task has changed since the run began; these are the numbers of the present code"
    ]
