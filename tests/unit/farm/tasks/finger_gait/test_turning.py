"""The script of benchmarks/turning.py turns the plate; how the task `turning` rewards it."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.turning import Keys, Script, script_of, task, turn
from farm.errors import ConfigError
from farm.policies.base import PolicyConfig
from farm.policies.networks import Linear
from farm.runner import Runner
from farm.tasks.base import Record
from farm.tasks.finger_gait.hand import FINGERS, JOINTS
from farm.tasks.finger_gait.holding import CONTROL_PERIOD, SUBSTEPS, TIMESTEP
from farm.tasks.finger_gait.turning import TERMS, Turning, TurningConfig, turned
from farm.tasks.loop import Batch, again

pytestmark = pytest.mark.usefixtures("grips_found_once")


@pytest.fixture(scope="module")
def gait():
    return task()


@pytest.fixture(scope="module")
def targets(gait):
    """One cycle's."""
    return script_of(Keys(gait.hand, Script()), 1)


@pytest.fixture(scope="module")
def scripted(gait, targets):
    """A cycle of it, from the nominal start and from a perturbed one."""
    return turn(gait, targets, [None, (4, 0, 0, 0)])


def test_a_cycle_turns_the_plate_and_holds_it(scripted):
    assert not scripted.lost.any()
    assert (scripted.degrees[:, -1] > 20.0).all()
    assert scripted.tilt.max() < 15.0
    assert scripted.drift.max() < 0.01


def test_fingers_are_lifted_in_turn_and_the_thumb_never(scripted):
    away = ~scripted.felt[0].all(axis=0)
    assert away[FINGERS.index("index")]
    assert away[FINGERS.index("middle")]
    assert not away[FINGERS.index("thumb")]
    assert (scripted.felt.sum(axis=-1) >= 2).all()


def test_a_plate_is_lost_where_it_is_out_of_place(scripted):
    assert scripted.first(0).qpos.shape == (1, *scripted.qpos.shape[1:])
    dropped = replace(scripted, lost=scripted.lost | (np.arange(scripted.lost.shape[1]) >= 50))
    assert dropped.first(1).degrees.shape == (1, 50)


def test_nothing_but_fingertips_touches_the_plate(gait, scripted):
    hand = gait.hand
    data = mujoco.MjData(hand.model)
    touched = set()
    for data.qpos[:] in scripted.qpos[0]:
        mujoco.mj_forward(hand.model, data)
        touched |= set(data.contact.geom.flat)
    assert touched == {*hand.tip_geoms, hand.model.geom("plate").id}


def test_it_turns_as_far_with_a_finer_step_of_the_physics(gait, targets, scripted):
    finer = copy.copy(gait.model)
    finer.opt.timestep = TIMESTEP / 5
    data = mujoco.MjData(finer)
    data.qpos[:], data.eq_active[:] = scripted.qpos[0, 0], 0
    for data.ctrl[:] in targets:
        mujoco.mj_step(finer, data, 5)
    w, x, y, z = data.qpos[-4:]
    degrees = -np.degrees(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
    assert degrees == pytest.approx(scripted.degrees[0, -1], abs=3.0)


# ---------------------------------------------------------------- the task

STEPS = 20
SEEDS = [None, (5, 0, 0, 1), (5, 0, 0, 2), (5, 0, 0, 3)]


@pytest.fixture(scope="module")
def runner():
    turning = Turning(TurningConfig(state="phase+joints+forces", steps=STEPS))
    simulator = Runner(turning, Linear(PolicyConfig(), turning.spec(), {}))
    yield simulator
    simulator.close()


def played(runner, targets):
    """Return from the nominal start when these joint targets (T, 8) are played."""

    def play():
        batch = Batch(runner.task, runner.sim, [None])
        for each in targets:
            batch.step((each - runner.task.start_commands[0])[None])
        return batch.rollouts()

    return again(play).returns[0]


def judged(speed, steps=STEPS, tilt=0.0):
    """Reward terms and success of a plate that turns at a speed [deg/s] and leans by a tilt
    [rad].
    """
    angle = -0.5 * np.deg2rad(speed) * CONTROL_PERIOD * np.arange(STEPS + 1)
    qpos = np.zeros((1, STEPS + 1, 15))
    qpos[0, :, 11] = np.cos(angle) * np.cos(tilt / 2)
    qpos[0, :, 14] = np.sin(angle) * np.cos(tilt / 2)
    qpos[0, :, 12] = np.cos(angle) * np.sin(tilt / 2)
    qpos[0, :, 13] = np.sin(angle) * np.sin(tilt / 2)
    frames = {"qpos": qpos[:, 1:], "target": np.zeros((1, STEPS, 8))}
    start = {"qpos": qpos[:, 0], "target": np.zeros((1, 8))}
    record = Record(
        frames,
        start,
        np.zeros((1, STEPS, 8)),
        np.array([steps]),
        np.array([False]),
        np.zeros(1, int),
    )
    score = Turning(TurningConfig(steps=STEPS, wanted=50.0)).score(record)
    return (
        dict(zip(TERMS, score.terms[0].T, strict=True)),
        score.terms.sum(),
        bool(score.success[0]),
    )


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_turn_is_positive_clockwise(tilt):
    angles = np.deg2rad([0.0, -3.0, -8.0, 2.0])
    c, s = np.cos(angles / 2), np.sin(angles / 2)
    lean, over = np.cos(tilt / 2), np.sin(tilt / 2)
    pose = np.stack([*np.zeros((3, 4)), c * lean, c * over, s * over, s * lean], axis=-1)
    np.testing.assert_allclose(np.degrees(turned(pose)), [3.0, 5.0, -10.0], atol=0.03)


def test_the_slowed_script_earns_more_than_holding_still(runner):
    keys = Keys(runner.task.hand, Script(stroke=1.0, move=0.2))
    slow = script_of(keys, 1)[SUBSTEPS - 1 :: SUBSTEPS][:STEPS]
    still = np.tile(runner.task.start_commands[0], (STEPS, 1))
    assert played(runner, slow) > 0.05 > played(runner, still) > -0.05


def test_a_spun_plate_earns_less_than_a_slow_one():
    returns = {speed: judged(speed)[1] for speed in (-20.0, 0.0, 25.0, 50.0, 75.0, 300.0)}
    assert max(returns, key=returns.__getitem__) == 50.0
    assert returns[-20.0] < returns[0.0] == 0.0 < returns[25.0] == pytest.approx(0.5, abs=0.01)
    assert returns[300.0] < returns[0.0] < returns[75.0] < returns[50.0]


def test_success_is_turning_that_lasts():
    assert judged(30.0)[2]
    assert not judged(20.0)[2]
    assert not judged(60.0, steps=STEPS - 1)[2]


def test_tilting_and_losing_the_plate_cost():
    assert judged(50.0, tilt=0.2)[1] < judged(50.0)[1]
    terms, _, _ = judged(50.0, steps=5)
    assert (terms["drop"][:5] == 0.0).all()
    assert (terms["drop"][5:] == -1.0 / STEPS).all()
    assert (terms["turn"][5:] == 0.0).all()


@pytest.mark.parametrize(
    ("state", "size"),
    [("phase", 6), ("phase+joints", 14), ("phase+forces", 9), ("phase+joints+forces", 17)],
)
def test_what_is_seen(runner, state, size):
    turning = runner.task
    before, turning.config = turning.config, TurningConfig(state=state, cycle=1.0, steps=STEPS)

    def look():
        batch = Batch(turning, runner.sim, SEEDS)
        first = np.array(batch.observe())
        for _ in range(10):
            batch.step(np.zeros((len(SEEDS), len(JOINTS))))
        return first, np.array(batch.observe())

    try:
        first, later = again(look)
        assert first.shape == (len(SEEDS), turning.spec().observation) == (len(SEEDS), size)
    finally:
        turning.config = before
    assert (first[:, :6] == 0.0).all()
    np.testing.assert_allclose(later[:, :6], 0.0, atol=1e-12)
    assert (first[0, 6:] != first[1, 6:]).all()


def test_rollouts_do_not_depend_on_their_batch(runner):
    theta = np.random.default_rng(0).normal(0.0, 0.05, (len(SEEDS), runner.size))
    together, back = runner.rollouts(theta, SEEDS), runner.rollouts(theta[::-1], SEEDS[::-1])
    alone = runner.rollouts(theta[2:3], SEEDS[2:3])
    assert together.returns.tobytes() == back.returns[::-1].tobytes()
    assert together.terms[2].tobytes() == alone.terms[0].tobytes()


def test_a_plate_is_lost_where_it_is_let_go(runner):
    theta = np.zeros((1, runner.size))
    theta.reshape(len(JOINTS), -1)[:, -1] = -1.0
    rollouts = runner.rollouts(theta, [None])
    assert rollouts.ended[0]
    assert not rollouts.success[0]
    assert rollouts.returns[0] < -0.5


def test_settings_that_make_no_sense():
    with pytest.raises(
        ConfigError, match="unknown state 'phase.smell'; known are phase, phase.joints"
    ):
        TurningConfig(state="phase+smell")
    with pytest.raises(ConfigError, match="cycle is 0.0; expected"):
        TurningConfig(cycle=0.0)
