"""A policy with memory learns what none without can: an early cue decides which later action is
right.
"""

from pathlib import Path

import pytest
from alone import Alone

from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner

CUE = """
import numpy as np
import farm

class Cue(farm.Task):
    xml = '''<mujoco>
      <worldbody>
        <body><joint name="x" type="slide" axis="1 0 0"/><geom size="1"/></body>
      </worldbody>
      <actuator><motor joint="x"/></actuator>
    </mujoco>'''
    steps = 6

    def reset(self, sim, row, rng):
        cue = sim.own.setdefault("cue", np.zeros(len(sim)))
        cue[row] = 1.0 if rng is None else rng.choice([-1.0, 1.0])

    def observe(self, sim):  # the cue at the start, later only a constant
        return np.stack([sim.own["cue"] * (sim.t == 0), np.ones(len(sim))], axis=1)

    def reward(self, sim, action):  # in the last three of six steps the action's sign is the cue's
        return sim.own["cue"] * np.clip(action[:, 0], -1.0, 1.0) * (sim.t > 3)
"""


def robust(task: str, policy: str, folder: Path, **changed: object) -> float:
    """Mean return of the learnt policy on 100 starts: 3 is perfect.

    58 of their cues have one sign, so always the same action returns 0.48, the most without memory.
    """
    config = configure(
        task,
        policy=policy,
        algorithm="snes",
        pairs=15,
        generations=60,
        initial_sigma=0.5,
        episodes=4,
        **changed,
    )
    problem, at = setup.start(config, "r")
    learner, alone = Learner(problem, RunFolder.create(folder, config), at), Alone(problem)
    for _ in learner.learn(alone):  # type: ignore[arg-type]
        pass
    return learner.evaluate(alone).robust_return  # type: ignore[arg-type]


@pytest.mark.slow
def test_an_early_cue_is_remembered_by_an_rnn_and_by_no_mlp(tmp_path: Path) -> None:
    (tmp_path / "cue.py").write_text(CUE)
    task = f"{tmp_path / 'cue.py'}:Cue"
    assert robust(task, "rnn", tmp_path / "rnn", units=4) > 2.5
    assert abs(robust(task, "mlp", tmp_path / "mlp", layers=(4,))) < 0.49
