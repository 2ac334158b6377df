"""A task that imports a neighbour, learnt by two workers with copies in another folder."""

import shutil
from pathlib import Path

import pytest
from learning import learnt
from made import POLE, pole

from farm.errors import CheckpointError
from learner.run.config import configure

HEAD = "__neighbours__ = ('gaits',)\nfrom gaits import level\n"
TASK = HEAD + POLE.replace("np.cos", "level() * np.cos")


def made(folder: Path, level: float = 3.0) -> Path:
    pole(folder, f"def level():\n    return {level}\n", "gaits.py")
    return pole(folder, TASK)


def test_two_workers_learn_it_from_copies(tmp_path: Path) -> None:
    mine = made(tmp_path / "mine")
    copy = tmp_path / "copy"
    shutil.copytree(mine.parent, copy)
    config = configure(f"{mine}:Pole", generations=2, pairs=4)
    by_two = learnt(config, tmp_path / "two", 2, copy / "pole.py")
    by_one = learnt(config, tmp_path / "one", 1, mine)
    assert by_two["parameters_sha256"] == by_one["parameters_sha256"]
    assert by_two["robust_return"] == pytest.approx(12.0, abs=1.0), "four steps of at most 3"
    made(tmp_path / "mine", 2.0)
    with pytest.raises(CheckpointError, match="the code of its task has changed"):
        learnt(config, tmp_path / "two", 2, copy / "pole.py", resume=True)
