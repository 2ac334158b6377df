"""Policies of finished runs, loaded."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from alone import learnt, state

import farm
from farm.errors import ConfigError
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.tools.replay.loaded import load

pytestmark = pytest.mark.usefixtures("grips_found_once")


def test_a_policy_that_was_learnt(pole: str, tmp_path: Path) -> None:
    reports = learnt(configure(pole), tmp_path / "r")
    policy = farm.load(tmp_path / "r")
    assert policy.generation == 3
    assert policy.mu.tobytes() == state(tmp_path / "r")[0]
    for generation in range(3):  # a generation shows the mean that it explored around
        earlier = load(tmp_path / "r", generation)
        assert earlier.rollout().trajectory.value == reports[generation].progress.mean_policy_return
    with pytest.raises(
        ConfigError, match="generation 7 is not stored in .*: stored are 1 to 3, the nearest is 3"
    ):
        load(tmp_path / "r", 7)
    with pytest.raises(ConfigError, match=r"no settings of .*:Pole: friction"):
        load(tmp_path / "r", friction=0.5)


def test_a_policy_under_other_settings_keeps_the_runs_texts(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    texts = at.files | {"model.xml": at.files["model.xml"].replace("0.1", "0.7")}
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, files=texts))
    light, heavy = load(tmp_path / "r"), load(tmp_path / "r", mass=5.0)
    assert light.problem.task.sources == heavy.problem.task.sources == texts
    assert (light.problem.task.model.body_mass[1], heavy.problem.task.model.body_mass[1]) == (
        1.0,
        5.0,
    )
    assert light.rollout().trajectory.value != heavy.rollout().trajectory.value
    copied = shutil.copytree(tmp_path / "r", tmp_path / "copy")
    assert load(copied).rollout().trajectory.value == light.rollout().trajectory.value


def test_another_object_in_the_hand_of_the_run(tmp_path: Path) -> None:
    """The hand is the run's, whatever this machine's is.

    The object is the one that was asked for.
    """
    config = configure()
    at = setup.start(config, "r")[1]
    folder = RunFolder.create(tmp_path / "r", config)
    texts = at.files | {
        "hand.xml": at.files["hand.xml"].replace("<mujoco", "<!-- the run's -->\n<mujoco", 1)
    }
    assert texts != at.files
    checkpoints.save(folder.checkpoint, replace(at, files=texts))
    task = load(folder.path, object="cylinder").problem.task
    assert task.sources["hand.xml"] == texts["hand.xml"]
    assert task.sources["object.xml"] != texts["object.xml"]
    assert task.config.object == "cylinder"
    assert load(folder.path).problem.task.sources == texts
