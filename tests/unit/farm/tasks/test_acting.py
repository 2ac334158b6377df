"""A policy with memory in the closed loop: each rollout has its own, whatever happens to the
others.
"""

import numpy as np
import pytest

from farm.arrays import FloatArray
from farm.errors import TaskError
from farm.policies.base import Policy, PolicyConfig
from farm.policies.normalised import Normalised
from farm.policies.recurrent import Cpg, Rnn
from farm.runner import Runner
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.base import Task
from farm.tasks.loop import Acting
from farm.tasks.probe import specification


class Slides(Task):
    """Two carts, of which the first may leave: rollouts end at different times."""

    xml = """<mujoco><option timestep="0.01"/><worldbody>
      <body><joint name="a" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body>
      <body pos="0 1 0"><joint name="b" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/></body>
      </worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
    steps, substeps = 9, 5

    def reset(self, sim: Sim, row: int, rng: np.random.Generator | None) -> None:
        """Push it."""
        if rng is not None:
            sim.qvel[row] = rng.normal(0.0, 2.0, 2)

    def reward(self, sim: Sim, action: FloatArray) -> FloatArray:
        """Anything that depends on all."""
        return sim.qpos[:, 0] - action[:, 1]

    def ended(self, sim: Sim) -> np.ndarray:
        """It left."""
        return np.abs(sim.qpos[:, 0]) > 0.3


class Counts(Policy):
    """Acts by the number of its steps so far, which is its memory."""

    size = 1
    memory = np.array([0.0, 5.0])

    def act(self, prepared, x, memory):  # type: ignore[override]
        """Each has its own count; the second number stays."""
        return np.stack([memory[:, 0], memory[:, 1]], axis=1) * prepared, memory + [1.0, 0.0]


@pytest.fixture(scope="module")
def task() -> Task:
    return Slides()


def new_runner(
    task: Task, kind: type[Policy] = Counts, size: int = 64, **settings: object
) -> Runner:
    config = kind.Config(**settings)  # type: ignore[arg-type]
    return Runner(
        task, kind(config, specification(task), {}), lambda model: BatchEngine(model, size)
    )


def test_each_rollout_counts_its_own_steps_until_it_ends(task: Task) -> None:
    seeds = [(seed,) for seed in range(12)]
    rollouts = new_runner(task).rollouts(np.ones((12, 1)), seeds)
    assert len(set(rollouts.steps.tolist())) > 3, "they end at different times"
    for steps, actions in zip(rollouts.steps.tolist(), rollouts.actions, strict=True):
        assert actions[:steps].tolist() == [[t, 5.0] for t in range(steps)]
    assert Counts.memory.tolist() == [0.0, 5.0]


@pytest.mark.parametrize(("kind", "settings"), [(Rnn, {"units": 3}), (Cpg, {"frequency": 2.0})])
@pytest.mark.parametrize("normalise", [False, True])
def test_no_batch_changes_a_bit(
    task: Task, kind: type[Policy], settings: dict[str, float], normalise: bool
) -> None:
    large, small = (new_runner(task, kind, size, **settings) for size in (64, 5))
    if normalise:
        normaliser = np.random.default_rng(1).uniform(0.5, 1.0, (2, 4))
        large.policy, small.policy = (
            Normalised(each.policy, normaliser) for each in (large, small)
        )
    theta = np.random.default_rng(0).normal(size=(12, large.size))
    seeds = [(seed % 5,) for seed in range(12)]
    together = large.rollouts(theta, seeds)
    assert len(set(together.steps.tolist())) > 1
    order = np.random.default_rng(2).permutation(12)
    for others, rows in (
        (small.rollouts(theta, seeds), np.arange(12)),
        (large.rollouts(theta[order], [seeds[i] for i in order]), order),
    ):
        assert others.returns.tobytes() == together.returns[rows].tobytes()
        assert others.actions.tobytes() == together.actions[rows].tobytes()
    alone = [
        large.rollouts(theta[i : i + 1], seeds[i : i + 1]).actions[0].tobytes() for i in range(12)
    ]
    assert alone == [actions.tobytes() for actions in together.actions]


def test_what_a_rollout_forgets_is_its_own_alone(task: Task) -> None:
    acting = Acting(
        Counts(PolicyConfig(), specification(task), {}), np.array([[1.0], [10.0], [100.0]])
    )
    x = np.zeros((3, 4))
    assert acting.act(x)[:, 0].tolist() == [0.0, 0.0, 0.0]
    assert acting.act(x[:2], np.array([2, 0]))[:, 0].tolist() == [100.0, 1.0]
    acting.forget(np.array([0]))
    assert acting.act(x)[:, 0].tolist() == [0.0, 10.0, 200.0]


@pytest.mark.parametrize(
    ("act", "line"),
    [
        (
            lambda x, memory: x[:, :2],
            r"act of the policy gave a ndarray; expected \(action, memory\), as the policy",
        ),
        (
            lambda x, memory: (x[:, :2], memory[:1]),
            r"memory from act .* \(1, 2\); expected an array of shape \(3, 2\)",
        ),
        (
            lambda x, memory: (x[:, :2], memory.tolist()),
            r"memory from act .* a list; expected an array of shape",
        ),
        (
            lambda x, memory: (x[:1, :2], memory),
            r"act of the policy .* \(1, 2\); expected an array of shape \(3, 2\)",
        ),
    ],
)
def test_a_memory_that_cannot_be_is_one_line(task: Task, act, line: str) -> None:
    runner = new_runner(task)
    runner.policy.act = lambda _, x, memory: act(x, memory)  # type: ignore[method-assign,assignment]
    with pytest.raises(TaskError, match=line):
        runner.rollouts(np.ones((3, 1)), [None] * 3)
