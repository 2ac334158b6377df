"""`farm stress`: a learnt policy under each cause alone and all together, from the starts of an
evaluation.
"""

import json
from pathlib import Path
from typing import Any

import pytest
from learning import learnt

from farm.__main__ import main
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.tools.evaluate.evaluate import evaluate
from learner.tools.replay.loaded import loaded
from learner.tools.stress.stress import ALL, cells, sensible, stressed

TASK = '''
import numpy as np
from farm import Robust, Task

class Cart(Task):
    """Stay within 0.4 m, where a spring holds the cart."""

    xml = """<mujoco><worldbody><body name="cart">
        <joint name="x" type="slide" axis="1 0 0" damping="1" stiffness="1"/>
      <geom size="0.1" mass="1"/></body></worldbody><actuator>
          <motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>"""
    steps, substeps = 20, 20
    ending = "left"

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.1 if rng is None else rng.uniform(-0.1, 0.1)

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0])

    def ended(self, sim):
        return np.abs(sim.qpos[:, 0]) > 0.4
'''
DECLARED = TASK.replace(
    "steps,", "robust = Robust(noise=0.001, push=(15.0, 20.0), body='cart')\n    steps,", 1
)
UNSTABLE = TASK.replace(
    "        return -np.abs(sim.qpos[:, 0])\n",
    "        return np.where(abs(sim.qvel[:, 0]) > 1e3, np.nan, -np.abs(sim.qpos[:, 0]))\n",
).replace(
    "\n    def reward",
    "\n        if rng is not None and rng.uniform() < 0.3:\n            sim.qvel[row] = 1e6\n"
    "\n    def reward",
)
"""Of which some rollouts fail."""

SMALL: dict[str, Any] = {"generations": 2, "pairs": 3, "policy": "linear", "initial_sigma": 0.1}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of the task with conditions and without."""
    folder = tmp_path_factory.mktemp("stress")
    paths = {}
    for name, text in (("plain", TASK), ("declared", DECLARED), ("unstable", UNSTABLE)):
        file = folder / f"{name}.py"
        file.write_text(text)
        paths[name] = folder / "runs" / name
        learnt(configure(f"{file}:Cart", **SMALL), paths[name], 1, file)
    return paths


@pytest.mark.slow
def test_causes_alone_and_together_from_the_starts_of_an_evaluation(runs: dict[str, Path]) -> None:
    policy = loaded(RunFolder.open(runs["declared"]))
    robust = policy.problem.task.robust
    assert robust is not None
    counts = list[int]()
    stress = stressed(policy, robust, (0.0, 1.0), 12, 3, counts.append)
    assert sum(counts) == 12 * cells(robust, (0.0, 1.0)) == 12 * 4
    assert list(stress.cells) == ["noise", "push", ALL]
    assert [row[0] for row in stress.cells.values()] == [stress.cells["noise"][0]] * 3
    assert stress.cells["noise"][1]["ended"] == stress.cells["noise"][0]["ended"] == 0
    assert stress.cells["push"][1]["ended"] > 5, "15 N for 0.2 s are 3 m/s"
    whole = evaluate(runs["declared"], rollouts=12, seed=3)["perturbed"]
    for name in ("ended", "return_mean", "return_min"):
        assert stress.cells[ALL][1][name] == whole[name], (
            "an evaluation has all of it at strength 1"
        )
    again = stressed(policy, robust, (1.0,), 12, 3)
    assert again.cells[ALL][0] == stress.cells[ALL][1]
    assert policy.problem.task.robust == robust


def test_a_table_of_80_columns_numbers_and_a_figure(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["stress", str(runs["declared"]), "--rollouts", "8", "--out", str(tmp_path / "out")])
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines if not line.startswith("written to ")) <= 80
    table = [line.split() for line in lines]
    assert ["times", "its", "range", "0", "0.5", "1", "1.5", "2"] in table
    push = next(row for row in table if row[:1] == ["push"])
    assert push[1] == "0%"
    assert int(push[-1].rstrip("%")) > 50
    assert "in each cell: left, and below it the mean return" in lines
    numbers = json.loads((tmp_path / "out" / "stress.json").read_text())
    assert numbers["conditions"]["push"] == [15.0, 20.0]
    assert numbers["declared"] is True
    assert push[-1] == f"{numbers['causes']['push'][4]['ended'] / 8:.0%}"
    assert [len(row) for row in numbers["causes"].values()] == [5, 5, 5]
    figure = (tmp_path / "out" / "stress.svg").read_text()
    assert all(text in figure for text in ("all together", "left (share)", "mean return"))


def test_a_task_that_declares_nothing_gets_sensible_ranges(
    runs: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    policy = loaded(RunFolder.open(runs["plain"]))
    robust = sensible(policy, 0)
    assert robust.causes == (
        "noise",
        "bias",
        "observation_delay",
        "action_delay",
        "motors",
        "mass",
        "payload",
        "friction",
        "push",
    )
    assert robust.body == "cart"
    assert robust.payload == (0.0, 0.1)
    assert robust.push == pytest.approx((0.0, 2.4525))
    assert isinstance(robust.noise, tuple)
    assert 0.0 < robust.noise[0] < 0.02
    unstable = loaded(RunFolder.open(runs["unstable"]))
    assert sensible(unstable, 0).noise[0] < 0.02, "failed rollouts say nothing of readings"
    assert main(["stress", str(runs["plain"]), "--rollouts", "4", "--strength", "1"]) == 0
    assert (
        "the task declares no farm.Robust: these are sensible ranges; 'cart' is pushed and loaded"
        in (capsys.readouterr().out)
    )
    assert (runs["plain"] / "stress" / "stress.json").is_file()


@pytest.mark.parametrize(
    ("run", "words", "line"),
    [
        (
            "plain",
            ["--strength", "2", "--strength", "1"],
            "strengths are 2, 1; expected rising ones",
        ),
        ("plain", ["--strength", "11"], "strength is 11; expected 0 to 10"),
        (
            "plain",
            ["--body", "trunk"],
            "task Cart: robust: there is no body 'trunk'; the model has cart",
        ),
        (
            "declared",
            ["--body", "cart"],
            "--body cart: the task declares its conditions, and their body",
        ),
        (
            "declared",
            ["--strength", "0", *(["--strength", "3"] * 9)],
            "--strength is given 10 times; expected at most",
        ),
        ("declared", ["--video", "worst.png"], "worst.png"),
    ],
)
def test_bad_input_is_one_line(
    runs: dict[str, Path], capsys: pytest.CaptureFixture[str], run: str, words: list[str], line: str
) -> None:
    assert main(["stress", str(runs[run]), *words]) == 2
    captured = capsys.readouterr().err.strip().splitlines()
    assert len(captured) == 1
    assert line in captured[0]
