"""The backend `warp` on the processor, which MuJoCo Warp can use as a device: few worlds, the same
code.
"""

import mujoco
import numpy as np
import pytest

from farm import seeds
from farm.arrays import FloatArray
from farm.errors import FarmError
from farm.net.work import Jobs
from farm.policies.networks import Linear
from farm.policies.recurrent import Cpg, Rnn
from farm.runner import Runner, is_exact, make_backend
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.base import Task, TaskConfig
from farm.tasks.probe import specification

# Compiling takes a minute, once for each machine
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
pytest.importorskip("mujoco_warp")
warp = pytest.importorskip("workers.backends.warp")

ROWS = 6


class Kicked(Task):
    """A paddle pushes a ball over the ground; the ball's mass differs between rollouts."""

    xml = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.05"><freejoint/><geom size="0.05" mass="0.2"/></body>
    <body pos="-0.06 0 0.2">
      <joint name="a" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.01" mass="0.3"/>
    </body>
  </worldbody>
  <actuator><position joint="a" kp="2"/></actuator>
</mujoco>"""
    steps, substeps = 5, 10

    def reset(self, sim: Sim, row: int, rng: np.random.Generator | None) -> None:
        """Draw mass and position."""
        if rng is not None:
            sim.expand("body_mass")[row, 1] *= rng.uniform(0.5, 2.0)
            sim.qpos[row, :2] += rng.uniform(0.0, 0.01, 2)

    def reward(self, sim: Sim, action: FloatArray) -> FloatArray:
        """The ball's distance and the paddle's angle."""
        reward: FloatArray = (
            sim.qpos[:, 0] + 0.1 * sim.xquat[:, 2, 2] - 0.01 * (action * action).sum(axis=1)
        )
        return reward


@pytest.fixture(scope="module")
def runners() -> tuple[Runner, Runner]:
    """Of one task, on the processor and in Warp."""
    backend = make_backend("warp")
    assert not is_exact(backend)
    task = Kicked(TaskConfig())
    policy = Linear(Linear.Config(), specification(task), {})
    return Runner(task, policy), Runner(task, policy, backend.engine, exact=False)


def jobs(policy: Linear) -> Jobs:
    """Three pairs, and the mean, shown."""
    eps = 0.3 * np.random.default_rng(0).standard_normal((3, policy.size))
    trials = [seeds.evaluation_start(0, i) for i in range(3)]
    return Jobs.joined([Jobs.exploring(eps, (1, -1), trials), Jobs.mean("control", [None])])


class Either(Kicked):
    """With one of two paddles."""

    def models(self) -> list[str]:
        """The second has a knob, so that its data have another layout."""
        return [
            self.xml,
            self.xml.replace(
                'mass="0.3"/>', 'mass="0.3"/><geom pos="0 0 -0.15" size="0.02" mass="0.1"/>'
            ),
        ]

    def which(self, rng: np.random.Generator) -> int:
        """Draw one."""
        return int(rng.integers(2))


def test_several_models_in_one_batch_are_mujocos_to_single_precision() -> None:
    task = Either(TaskConfig())
    policy = Linear(Linear.Config(), specification(task), {})
    cpu, gpu = Runner(task, policy), Runner(task, policy, make_backend("warp").engine, exact=False)
    theta = 0.3 * np.random.default_rng(0).standard_normal((ROWS, cpu.size))
    trials = [None, *(seeds.evaluation_start(0, i) for i in range(ROWS - 1))]
    expected, rollouts = cpu.rollouts(theta, trials), gpu.rollouts(theta, trials)
    assert set(expected.which) == {0, 1}
    np.testing.assert_array_equal(rollouts.which, expected.which)
    np.testing.assert_allclose(rollouts.returns, expected.returns, atol=2e-4)


def test_returns_are_mujocos_to_single_precision(runners: tuple[Runner, Runner]) -> None:
    cpu, gpu = runners
    theta = 0.3 * np.random.default_rng(0).standard_normal((ROWS, cpu.size))
    trials = [None, *(seeds.evaluation_start(0, i) for i in range(ROWS - 1))]
    expected, rollouts = cpu.rollouts(theta, trials), gpu.rollouts(theta, trials)
    assert np.allclose(rollouts.start["qpos"], expected.start["qpos"], atol=1e-6)
    assert not np.array_equal(rollouts.returns, expected.returns), "it was Warp that simulated"
    np.testing.assert_allclose(rollouts.returns, expected.returns, rtol=1e-3)
    np.testing.assert_allclose(rollouts.frames["qpos"], expected.frames["qpos"], atol=1e-4)


def test_a_rollouts_numbers_do_not_depend_on_the_others(runners: tuple[Runner, Runner]) -> None:
    _, gpu = runners
    theta = 0.3 * np.random.default_rng(0).standard_normal((ROWS, gpu.size))
    trials = [None, *(seeds.evaluation_start(0, i) for i in range(ROWS - 1))]
    together, order = gpu.rollouts(theta, trials), np.random.default_rng(1).permutation(ROWS)
    permuted = gpu.rollouts(theta[order], [trials[i] for i in order])
    alone = gpu.rollouts(theta[2:3], [trials[2]])
    assert np.array_equal(permuted.returns, together.returns[order])
    assert np.array_equal(alone.frames["qpos"][0], together.frames["qpos"][2])


def test_a_policy_with_memory_acts_alike(runners: tuple[Runner, Runner]) -> None:
    cpu, gpu = runners
    trials = [seeds.evaluation_start(0, i) for i in range(ROWS)]
    for policy in (
        Rnn(Rnn.Config(units=3), cpu.spec, {}),
        Cpg(Cpg.Config(frequency=3.0), cpu.spec, {}),
    ):
        theta = 0.5 * np.random.default_rng(0).standard_normal((ROWS, policy.size))
        with pytest.MonkeyPatch.context() as patched:
            for each in runners:
                patched.setattr(each, "policy", policy)
            expected, rollouts = cpu.rollouts(theta, trials), gpu.rollouts(theta, trials)
        np.testing.assert_allclose(rollouts.actions, expected.actions, atol=1e-3)
        assert np.ptp(rollouts.actions, axis=1).min() > 1e-3


def test_the_mean_and_what_is_shown_are_the_processors(runners: tuple[Runner, Runner]) -> None:
    cpu, gpu = runners
    work, mu = jobs(cpu.policy), np.full(cpu.size, 0.1)  # type: ignore[arg-type]
    expected, outcome = cpu.run(mu, work), gpu.run(mu, work)
    assert outcome.returns[-1] == expected.returns[-1]
    assert np.array_equal(outcome.trajectories[0].bodies, expected.trajectories[0].bodies)
    assert (outcome.returns[:-1] != expected.returns[:-1]).any()


def test_too_little_room_is_noticed_and_doubled(
    runners: tuple[Runner, Runner], monkeypatch: pytest.MonkeyPatch
) -> None:
    cpu, gpu = runners
    theta = 0.3 * np.random.default_rng(0).standard_normal((2, cpu.size))
    monkeypatch.setattr(warp, "_defaults", lambda _: (1, 2))
    small = Runner(cpu.task, cpu.policy, lambda model: warp.WarpEngine(model, 4), exact=False)
    got = small.rollouts(theta, [None, None])
    assert small.sim.engine._room > warp._ROOM  # type: ignore[attr-defined]
    np.testing.assert_allclose(got.returns, gpu.rollouts(theta, [None, None]).returns, rtol=0.02)
    monkeypatch.setattr(warp, "_MOST_ROOM", 2)
    small = Runner(cpu.task, cpu.policy, lambda model: warp.WarpEngine(model, 4), exact=False)
    with pytest.raises(FarmError, match="has no room for this model's contacts"):
        small.rollouts(theta, [None, None])


def test_a_model_that_it_cannot_simulate_is_refused_in_a_line() -> None:
    joints = "".join('<body><joint type="slide"/><geom size="0.1"/></body>' for _ in range(61))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option jacobian="dense"/><worldbody>{joints}</worldbody></mujoco>'
    )
    assert BatchEngine(model, 1).size == 1
    with pytest.raises(
        FarmError, match="MuJoCo Warp cannot simulate this model: Dense is unsupported"
    ):
        warp.WarpEngine(model, 4)


def test_flags_that_mean_nothing_there_are_no_obstacle() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option><flag midphase="disable" autoreset="disable"/></option>'
        '<worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    assert warp.WarpEngine(model, 4).field("qpos").shape == (4, 7)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_MIDPHASE, "only a copy is changed"
