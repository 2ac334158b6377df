"""Loading a run's policy after the file of its task has changed, and rollouts that cannot be."""

import logging
from pathlib import Path

import numpy as np
import pytest
from made import POLE, pole

import farm
from farm.errors import ConfigError
from farm.seeds import evaluation_start
from learner.run import checkpoint as checkpoints
from learner.run.config import RunConfig
from learner.run.folder import RunFolder
from learner.run.setup import start
from learner.tools.replay.loaded import LoadedPolicy


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


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"seed": -1}, "seed '-1'; expected a whole number from 0 to 4294967295"),
        ({"seed": 2**32}, "seed '4294967296'; expected a whole number"),
        ({"seed": 1.5}, "seed '1.5'; expected a whole number"),
        ({"seed": True}, "seed 'True'; expected a whole number"),
        ({"theta": np.zeros(3)}, r"theta has shape \(3,\); expected finite numbers of shape"),
        ({"theta": np.full(50, np.nan)}, "theta is not finite; expected finite numbers of shape"),
        ({"theta": "x"}, "theta is a str; expected finite numbers of shape"),
    ],
)
def test_a_rollout_that_cannot_be_is_one_line(
    values: dict[str, object], line: str, tmp_path: Path
) -> None:
    policy = _policy(tmp_path)
    with pytest.raises(ConfigError, match=line):
        policy.rollout(**values)  # type: ignore[arg-type]


def test_rollouts_have_parameters_for_each_seed(tmp_path: Path) -> None:
    policy = _policy(tmp_path)
    two = np.stack([policy.mu, policy.mu + 0.1])
    assert len(policy.rollouts(two, [None, evaluation_start(0, 1)])) == 2
    for wrong in (two[:1], two[:, :3], two[0]):
        with pytest.raises(ConfigError, match=r"expected finite numbers of shape \(2, 50\)"):
            policy.rollouts(wrong, [None, None])


def test_a_number_of_numpy_is_a_start_as_any_other(tmp_path: Path) -> None:
    policy = _policy(tmp_path)
    value = policy.rollout(seed=3).trajectory.value
    assert value == policy.rollout(seed=np.int64(3)).trajectory.value  # type: ignore[arg-type]
    assert value == policy.rollout(seed=evaluation_start(0, 3)).trajectory.value
    assert value == policy.rollout(list(policy.mu), seed=3).trajectory.value  # type: ignore[arg-type]


def _policy(folder: Path) -> LoadedPolicy:
    config = RunConfig(task=f"{pole(folder)}:Pole")
    run = RunFolder.create(folder / "run", config)
    checkpoints.save(run.checkpoint, start(config, "run")[1])
    return farm.load(run.path)
