"""MuJoCo's warnings and errors reach whoever simulates, by rollout and once."""

import mujoco
import numpy as np
import pytest

from farm.errors import TaskError
from farm.policies.networks import Linear
from farm.runner import Runner
from farm.sim.complaints import KINDS, counters, explained
from farm.sim.engines import BatchEngine
from farm.tasks.base import Task
from farm.tasks.probe import specification

BALLS = "".join(
    f'<body pos="{0.15 * (i % 5)} {0.15 * (i // 5 % 5)} {0.1 + 0.15 * (i // 25)}"><freejoint/><geom'
    ' size=".08"/></body>'
    for i in range(50)
)


class Pile(Task):
    memory = "1M"
    steps, substeps = 5, 5

    def files(self):
        text = f"""<mujoco><size memory="{self.memory}"/><worldbody>
            <geom type="plane" size="3 3 .1"/>
          <body pos="-.2 .3 .1"><joint name="x" type="slide" damping="5" axis="1 0 0"/>
          <geom type="box" size=".1 .5 .1"/>
          </body>{BALLS}</worldbody><actuator>
              <motor joint="x" ctrlrange="-50 50"/></actuator></mujoco>"""
        return {"model.xml": text}

    def observe(self, sim):
        return sim.qpos[:, :1]

    def reward(self, sim, action):
        return sim.qpos[:, 1]


class Tight(Pile):
    memory = "400K"


class Roomy(Pile):
    memory = "50M"


class Nothing(Pile):
    memory = "50M"

    def act(self, sim, action):
        controls = super().act(sim, action)
        controls[sim.qpos[:, 0] < -1e-3] = np.nan
        return controls


def runner(kind: type[Task]) -> Runner:
    task = kind()
    spec = specification(task)
    return Runner(task, Linear(Linear.Config(), spec, {}))


def test_a_full_arena_is_warned_of_in_each_rollout():
    run = runner(Pile)
    run.rollouts(np.zeros((3, run.size)), [None] * 3)
    assert run.trouble.warned == {"CNSTRFULL": 3}
    assert run.trouble.errors == []
    assert "<size memory=" in explained("CNSTRFULL")


def test_a_model_with_room_warns_of_nothing():
    run = runner(Roomy)
    assert not run.rollouts(np.zeros((2, run.size)), [None] * 2).failed.any()
    assert not run.trouble.warned


def test_too_little_memory_is_said_in_the_words_of_mujoco():
    with pytest.raises(
        TaskError, match=r"unstable before control step 1: mj_stackAlloc: .*increase <size"
    ):
        runner(Tight)


def test_controls_that_are_no_numbers():
    run = runner(Nothing)
    theta = np.zeros((3, run.size))
    theta[1] = -5.0  # pushes to where act gives nan
    run.rollouts(theta, [None] * 3)
    assert run.trouble.warned == {"BADCTRL": 1}


def test_kinds_are_those_of_mujoco():
    data = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
    assert counters(data).tolist() == [0] * len(KINDS)
    for kind in KINDS:
        assert hasattr(mujoco.mjtWarning, f"mjWARN_{kind}")
        assert kind in explained(kind)


def test_counters_are_of_the_rows_that_are_asked_for():
    model = Pile().model
    engine = BatchEngine(model, 4)
    engine.reset(np.arange(4))
    engine.step(np.array([1, 3]), 10)
    at = KINDS.index("CNSTRFULL")
    counts = engine.warned(np.array([3, 0, 1]))[:, at]
    assert counts[1] == 0
    assert (counts[[0, 2]] > 0).all()
