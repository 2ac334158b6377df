"""Failed rollouts in what a run says and in what it learns from."""

import numpy as np
import pytest

from farm.net.work import Jobs, Simulated
from farm.returns import RETURN_FLOOR
from farm.tasks.base import TaskSpec
from learner.run.config import configure
from learner.run.evaluation import outcome, score
from learner.run.learner import learnt_from
from learner.run.parts import Parts
from learner.run.setup import problem

SPEC = TaskSpec(observation=1, action=1, steps=4, period=0.1)


def simulated(returns: list[float]) -> Simulated:
    flags = np.zeros((len(returns), 4), dtype=bool)
    flags[:, 2] = flags[:, 3] = np.array(returns) == RETURN_FLOOR
    return Simulated(
        trajectories=(),
        returns=np.array(returns),
        flags=flags,
        steps=np.ones(len(returns), dtype=int),
        traces=np.zeros((0, 4, 0), dtype="<f4"),
    )


def test_statistics_are_of_the_rollouts_that_did_not_fail():
    explore = Jobs.exploring(np.zeros((3, 1)), (1,), None)
    parts = Parts(explore=explore, mean=Jobs.mean("none", [None]))
    values = outcome(SPEC, simulated([1.0, RETURN_FLOOR, 3.0, RETURN_FLOOR]), parts)
    assert (
        values["return_mean"],
        values["return_min"],
        values["return_max"],
        values["return_std"],
    ) == (2, 1, 3, 1)
    assert (values["failed"], values["clamped"], values["mean_policy_return"]) == (1, 1, None)


def test_policies_are_compared_by_a_mean_in_which_failures_count():
    sound, failing = np.array([4.0, 6.0, 5.0]), np.array([4.0, 6.0, RETURN_FLOOR])
    assert score(sound) == 5.0
    assert score(failing) == pytest.approx((4.0 + 6.0 + 4.0 - 1.0) / 3)
    assert score(np.full(2, RETURN_FLOOR)) is None


@pytest.mark.parametrize("offset", [0.0, 2.0])
def test_an_episode_that_failed_counts_as_the_worst_of_the_generation(pole: str, offset: float):
    config = configure(
        pole, policy="linear", algorithm="ars", pairs=2, episodes=2, reward_offset=offset
    )
    returns = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, RETURN_FLOOR])
    steps = np.array([1, 1, 1, 1, 1, 1, 1, 4])
    of_rows = learnt_from(config, problem(config).task, returns, steps)
    sound = returns[:7] + offset
    worst = sound.min() - sound.std()
    expected = np.append(sound, worst).reshape(2, 2, 2).mean(axis=0)
    np.testing.assert_allclose(of_rows, expected, rtol=1e-14)
