"""Loading a run's policy after the file of its task has changed."""

import logging
from pathlib import Path

import numpy as np
import pytest
from made import POLE, pole

import farm
from learner.run import checkpoint as checkpoints
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.setup import start


def test_changed_code_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = pole(tmp_path)
    config = RunConfig(task=f"{path}:Pole")
    folder = RunFolder.create(tmp_path / "run", config)
    checkpoints.save(folder.checkpoint, start(config, "run")[1])
    with caplog.at_level(logging.WARNING):
        before = farm.load(folder.path).rollout().rollouts.returns
        assert not caplog.messages
        path.write_text(POLE.replace("np.cos", "1.0 + np.cos"))
        after = farm.load(folder.path).rollout().rollouts.returns
    np.testing.assert_allclose(after - before, 4.0)
    assert [m.partition(": ")[2] for m in caplog.messages] == [
        "the code of its task has changed since the run began; these are the numbers of the present"
        " code"
    ]
