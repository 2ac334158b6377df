"""Runs that are resumed, without a network."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alone import POLE, learnt, new_run, state, taken_up

from farm.errors import CheckpointError, RunError
from learner.run import checkpoint as checkpoints
from learner.run.config import configure
from learner.tools.replay.loaded import load

pytestmark = pytest.mark.usefixtures("grips_found_once")


def test_a_folder_that_was_removed_is_not_to_be_resumed(pole: str, tmp_path: Path) -> None:
    learner, alone = new_run(configure(pole, generations=3), tmp_path / "r")
    reports = learner.learn(alone)  # type: ignore[arg-type]
    next(reports)
    shutil.rmtree(tmp_path / "r")
    with pytest.raises(
        RunError, match=r"r was removed or emptied while it learnt, after generation 1$"
    ):
        next(reports)


def test_a_resumed_run_gives_the_same_numbers(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=4), tmp_path / "whole")
    learnt(configure(pole, generations=2), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=4)
    assert [report.progress.generation for report in learner.learn(alone)] == [3, 4]  # type: ignore[arg-type]
    assert state(tmp_path / "r") == state(tmp_path / "whole")
    assert learner.run == "r"
    assert taken_up(tmp_path / "r")[0].over


@pytest.mark.parametrize("algorithm", ["pgpe", "snes", "ars", "es", "cma-es", "sep-cma"])
def test_every_algorithm_is_resumed_to_the_same_bits(
    pole: str, tmp_path: Path, algorithm: str
) -> None:
    def after(path: Path) -> dict[str, object]:
        values = checkpoints.load(path / "checkpoint").state
        return {name: v.tobytes() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    config = configure(pole, algorithm=algorithm, generations=6, policy="linear", normalise=True)
    reports = learnt(config, tmp_path / "whole")
    learnt(replace(config, generations=3), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=6)
    assert len(list(learner.learn(alone))) == 3  # type: ignore[arg-type]
    assert after(tmp_path / "r") == after(tmp_path / "whole")
    assert after(tmp_path / "whole")["generation"] == 6
    assert (
        load(tmp_path / "whole", 5).rollout().trajectory.value
        == reports[5].progress.mean_policy_return
    )


def test_other_settings_are_refused(pole: str, tmp_path: Path) -> None:
    config = configure(pole, generations=1)
    learnt(config, tmp_path / "r")
    with pytest.raises(
        CheckpointError, match="is of another configuration: --seed is 0 there and 5 in config.json"
    ):
        taken_up(tmp_path / "r", seed=5)
    with pytest.raises(CheckpointError, match=r"--mass is 1\.0 there and 2\.0 in"):
        taken_up(tmp_path / "r", task_config=replace(config.task_config, mass=2.0))


def test_changed_code_is_refused_unless_numbers_may_differ(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    (tmp_path / "pole.py").write_text(POLE.replace("-np.abs", "-2.0 * np.abs"))
    with pytest.raises(
        CheckpointError,
        match=r"the code of its task has changed since the run began: .*--any-rounding",
    ):
        taken_up(tmp_path / "r", generations=2)
    learner, alone = taken_up(tmp_path / "r", generations=2, any_rounding=True)
    assert [report.progress.generation for report in learner.learn(alone)] == [2]  # type: ignore[arg-type]
    (tmp_path / "pole.py").write_text(POLE)
    taken_up(tmp_path / "r", generations=3)


def test_a_run_goes_on_with_its_own_texts(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    assert at.files["note"] == "read by nobody"
    texts = at.files | {"model.xml": at.files["model.xml"].replace("0.1", "0.7")}
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, files=texts))
    learner, _ = taken_up(tmp_path / "r")
    assert learner.problem.task.model.dof_damping[0] == 0.7
    assert learner.spec.files == texts, "workers are told of them too"


def test_a_checkpoint_of_another_algorithms_state(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    checkpoints.save(
        tmp_path / "r" / "checkpoint", replace(at, state={**at.state, "velocity": np.zeros(9)})
    )
    with pytest.raises(CheckpointError, match="checkpoint: .*velocity"):
        taken_up(tmp_path / "r")
