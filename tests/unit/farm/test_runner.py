"""From jobs to results with a small test task: signs, origins, rates, traces."""

from dataclasses import dataclass

import numpy as np
import pytest

from farm.net import codec
from farm.net.work import Jobs, Results, Simulated
from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner
from farm.settings import setting
from farm.sim.channels import Channel
from farm.tasks.base import Task, TaskConfig
from farm.tasks.probe import specification


class Pole(Task):
    """A pole that falls from any angle, if it is given a seed."""

    @dataclass(frozen=True, kw_only=True)
    class Config(TaskConfig):
        """Its own settings."""

        width: float = setting(3.0, above=0.0)
        """Angle at which it has fallen [rad]."""

    xml = """<mujoco><option timestep="0.01"/><worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02"/></body></worldbody>
      <actuator><motor joint="hinge"/></actuator></mujoco>"""
    steps, substeps = 5, 2
    channels = (
        Channel(name="angle", kind="scalars", shape=(1,), trace=True),
        Channel(name="turned", kind="flags", shape=(1,)),
    )

    def reset(self, sim, row, rng):
        """Turn it."""
        sim.qpos[row, 0] = 0.1 if rng is None else rng.uniform(-1.0, 1.0)

    def reward(self, sim, action):
        """Upright."""
        return np.cos(sim.qpos[:, 0])

    def ended(self, sim):
        """It fell."""
        return np.abs(sim.qpos[:, 0]) > self.config.width

    def success(self, sim):
        """To the right."""
        return sim.qpos[:, 0] > 0.0

    def measure(self, sim):
        """Its angle."""
        return {"angle": sim.qpos, "turned": (sim.qpos > 0.0).astype(float)}


@pytest.fixture(scope="module")
def runner():
    task = Pole()
    spec, config = specification(task), FeaturesConfig(features=10)
    return Runner(task, Direct(config, spec, Direct.draw(config, spec, np.random.default_rng(0))))


P = 10
MU = np.random.default_rng(1).normal(0.0, 1.0, P)
EPS = np.random.default_rng(2).normal(0.0, 2.0, (4, P))
SEEDS = [(1, 2, 3, i) for i in range(4)]


def same(one: Simulated, rows, other: Simulated, at) -> None:
    assert one.returns[rows].tobytes() == other.returns[at].tobytes()
    assert one.flags[rows].tobytes() == other.flags[at].tobytes()


@pytest.mark.parametrize("seeds", [None, SEEDS])
def test_a_pair_is_two_single_rollouts_from_the_same_start(runner, seeds):
    pairs = runner.run(MU, Jobs.exploring(EPS, (1, -1), seeds))
    assert len(set(pairs.returns.tolist())) == 8
    for column, sign in enumerate((1, -1)):
        same(
            pairs,
            slice(column, None, 2),
            runner.run(MU, Jobs.exploring(EPS, (sign,), seeds)),
            slice(None),
        )
    alone = Jobs.single(MU - EPS[2], "none", seeds[2] if seeds else None)
    same(pairs, [5], runner.run(9.0 * MU, alone), [0])


def test_jobs_do_not_know_of_each_other_and_their_rate_changes_no_figure(runner):
    jobs = Jobs.joined(
        [
            Jobs.exploring(EPS[:2], (1, -1), SEEDS[:2]),
            Jobs.mean("control", [None, SEEDS[3]]),
            Jobs.single(MU, "physics", None),
            Jobs.mean("physics", [SEEDS[3]]),
            Jobs.mean("none", [None, SEEDS[3]]),
        ]
    )
    together = runner.run(MU, jobs, "all")
    for row in (5, 7):  # the mean at control rate, at physics rate, and unseen
        same(together, [row], together, [9])
    for row in (4, 6):
        same(together, [row], together, [8])
    starts = np.cumsum(jobs.rollouts) - jobs.rollouts
    trajectories = iter(together.trajectories)
    for at in range(len(jobs)):
        alone = runner.run(MU, jobs.take([at]), "all")
        same(alone, slice(None), together, slice(starts[at], starts[at] + jobs.rollouts[at]))
        if jobs.seen[at]:
            [single] = alone.trajectories
            assert codec.encode(next(trajectories)) == codec.encode(single)
    frames = [len(trajectory.times) for trajectory in together.trajectories]
    assert frames == [6, 6, 11, 11]
    assert [t.value for t in together.trajectories] == together.returns[4:8].tolist()


def test_what_is_sent_is_what_the_receiver_expects(runner):
    jobs = Jobs.joined([Jobs.mean("control", [None]), Jobs.exploring(EPS, (1, -1), SEEDS)])
    head = {"run": "r", "incarnation": "i", "round": 0, "worker": "w/0"}
    for traces, count in (("none", 0), ("extremes", 2), ("all", 8)):
        results = Results.carrying(runner.run(MU, jobs, traces), jobs, 0.0, **head)
        back = codec.decode(codec.encode(results), Results)
        assert back.traces.shape[1:] == (5, 1)
        assert len(back.traces) == count
        assert back.trajectories[0].fits(runner.spec.shapes(len(runner.scene.bodies)))
    best, worst = int(back.returns[1:].argmax()), int(back.returns[1:].argmin())
    two = runner.run(MU, jobs, "extremes").traces
    assert two.tobytes() == back.traces[sorted((best, worst))].tobytes()


def test_an_end_and_its_trace(runner):
    fallen = Runner(Pole(Pole.Config(width=0.5)), runner.policy)
    outcome = fallen.run(MU, Jobs.exploring(EPS, (1,), SEEDS), "all")
    assert 0 < outcome.flags[:, 1].sum() < 4
    for row in range(4):
        last = np.flatnonzero(outcome.traces[row, :, 0])[-1]
        assert (last < 4 or abs(outcome.traces[row, last, 0]) > 0.5) == outcome.flags[row, 1]
        assert outcome.flags[row, 0] == (outcome.traces[row, last, 0] > 0)
    fallen.close()


@pytest.mark.parametrize("size", [1e200, 1e308])
def test_absurd_parameters_are_answered(runner, size):
    theta = np.where(np.arange(P) % 2, 1.0, -1.0) * size
    outcome = runner.run(MU, Jobs.single(theta, "control", None))
    assert np.isfinite(outcome.returns).all()
    codec.decode(codec.encode(outcome.trajectories[0]), type(outcome.trajectories[0]))


def test_the_seed_is_all_there_is_to_a_start(runner):
    outcome = runner.run(MU, Jobs.mean("none", [SEEDS[0], SEEDS[0], SEEDS[1], None]))
    assert outcome.returns[0] == outcome.returns[1]
    assert len(set(outcome.returns.tolist())) == 3
