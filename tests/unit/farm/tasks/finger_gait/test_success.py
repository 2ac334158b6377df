"""What counts as success: which fingers press, how far the object may move and turn, and when."""

import math

import numpy as np
import pytest
from covering import any_two
from gait import Frames, task
from hypothesis import given
from hypothesis import strategies as st

from farm.tasks.base import Record
from farm.tasks.finger_gait.hand import GRIPS, TIP_RADIUS
from farm.tasks.finger_gait.holding import (
    CONTROL_PERIOD,
    MAX_SHIFT,
    MAX_TURN,
    PRESSES,
    moved,
    touching,
)
from farm.tasks.rollouts import discounted

STEPS = 15
START = np.array([0.08, 0.04, 0.02, 1.0, 0.0, 0.0, 0.0])


def frames(count=1, force=1.0, steps=STEPS):
    """Return frames of rollouts in which every fingertip presses at its pad and the object
    stays.
    """
    qpos = np.tile(np.concatenate([np.linspace(0.3, 1.0, 8), START]), (count, steps, 1))
    forces, place = np.zeros((count, steps, 3, 4)), np.zeros((count, steps, 3, 4, 3))
    forces[..., 0], place[..., 0, :] = force, [TIP_RADIUS, 0.0, 0.0]
    return Frames(qpos, forces, place)


def score(gait, frames, actions, start, steps, failed):
    start = np.concatenate([np.zeros((len(start), 8)), start], axis=1)
    return gait.score(
        Record(frames.dict(), {"qpos": start}, actions, steps, failed, np.zeros(len(steps), int))
    )


def judged(frames, steps=STEPS, failed=False, **options):
    count = len(frames.qpos)
    actions = np.zeros((count, frames.qpos.shape[1], 8))
    start = np.tile(START, (count, 1))
    return score(
        task(**options), frames, actions, start, np.full(count, steps), np.full(count, failed)
    )


def turned(angle, axis=(0.0, 0.0, 1.0)):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis])


def test_the_figures_of_the_criterion():
    assert PRESSES == 0.1
    assert MAX_SHIFT == 0.015
    assert pytest.approx(math.radians(30)) == MAX_TURN
    assert pytest.approx(0.1) == CONTROL_PERIOD


@pytest.mark.parametrize(*any_two(grip=GRIPS, finger=(0, 1, 2), step=(11, 12, 13, 14)))
def test_the_fingers_of_the_goal_and_no_others_press_at_each_of_the_last_three_steps(
    grip, finger, step
):
    rollout, pressing = frames(), [name in GRIPS[grip] for name in ("index", "middle", "thumb")]
    rollout.force[:, :, np.logical_not(pressing)] = 0.0
    assert judged(rollout, goal_grip=grip).success[0]
    rollout.force[0, step, finger, 0] = 0.1 - 1e-9 if pressing[finger] else 0.1
    assert judged(rollout, goal_grip=grip).success[0] == (step < 12)


def test_a_tenth_of_a_newton_is_enough():
    assert judged(frames(force=0.1)).success[0]
    assert not judged(frames(force=math.nextafter(0.1, 0.0))).success[0]


def test_contacts_of_a_finger_press_together():
    rollout = frames(force=0.0)
    rollout.force[..., :2] = 0.06
    assert judged(rollout).success[0]


@pytest.mark.parametrize(
    *any_two(axis=(0, 1, 2), step=(11, 12, 13, 14), shift=(0.0149, -0.0149, 0.0151, -0.0151))
)
def test_the_object_stays_within_15_millimetres(axis, step, shift):
    rollout = frames()
    rollout.qpos[0, step, 8 + axis] += shift
    assert judged(rollout).success[0] == (abs(shift) < 0.015 or step < 12)


def test_the_shift_is_a_distance_not_a_component():
    rollout = frames()
    rollout.qpos[0, -1, 8:11] += 0.009  # 15.6 mm away
    assert not judged(rollout).success[0]


AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 3))


@pytest.mark.parametrize(
    *any_two(axis=AXES, step=(11, 12, 13, 14), degrees=(29.9, -29.9, 30.1, -30.1)), ids=str
)
def test_the_object_turns_less_than_30_degrees(axis, step, degrees):
    rollout = frames()
    rollout.qpos[0, step, 11:] = turned(math.radians(degrees), axis)
    assert judged(rollout).success[0] == (abs(degrees) < 30 or step < 12)
    rollout.qpos[0, step, 11:] *= -1
    assert judged(rollout).success[0] == (abs(degrees) < 30 or step < 12)


def test_the_pose_is_compared_with_that_at_release():
    rollout = frames()
    rollout.qpos[..., 8:11] += 0.1
    rollout.qpos[..., 11:] = turned(1.0)
    start = rollout.qpos[:, 0, 8:]
    outcome = score(
        task(), rollout, np.zeros((1, STEPS, 8)), start, np.array([STEPS]), np.array([False])
    )
    assert outcome.success[0]
    assert not judged(rollout).success[0]


@pytest.mark.parametrize("steps", [1, 12, 15])
def test_a_dropped_object_is_no_success(steps):
    rollout = frames()
    rollout.force[0, steps - 1] = 0.0
    outcome = judged(rollout, steps=steps)
    assert not outcome.success[0]
    assert outcome.terms[0, steps - 1, 4] == -400


@pytest.mark.parametrize("steps", [1, 15])
@pytest.mark.parametrize("force", [0.0, 1.0])
def test_a_failed_rollout_gives_the_penalty_alone(steps, force):
    outcome = judged(frames(force=force), steps=steps, failed=True)
    assert not outcome.success[0]
    assert outcome.terms[0, steps - 1].tolist() == [0, 0, 0, 0, -400]


def test_a_success_on_the_way_that_does_not_last_is_none():
    rollout = frames()
    rollout.force[0, 13:, 1] = 0.0
    assert not judged(rollout).success[0]


def test_success_is_judged_at_the_end_of_longer_rollouts_too():
    rollout = frames(steps=40)
    assert judged(rollout, steps=40).success[0]
    rollout.force[0, 37, 0] = 0.0
    assert not judged(rollout, steps=40).success[0]


def test_rollouts_of_a_batch_are_judged_apart():
    rng = np.random.default_rng(1)
    many = frames(6)
    many.force[:] = rng.exponential(0.3, many.force.shape) * (rng.random(many.force.shape) < 0.8)
    many.place[:] = rng.normal(size=many.place.shape) * TIP_RADIUS
    actions, failed = rng.normal(size=(6, STEPS, 8)), np.array([0, 0, 1, 0, 0, 1], dtype=bool)
    steps, start = np.array([15, 15, 4, 9, 15, 15]), np.tile(START, (6, 1))
    gait = task()
    together = score(gait, many, actions, start, steps, failed)
    for i in range(6):
        row = slice(i, i + 1)
        single = Frames(many.qpos[row], many.force[row], many.place[row])
        alone = score(gait, single, actions[row], start[row], steps[row], failed[row])
        assert together.terms[i].tobytes() == alone.terms[0].tobytes()
        assert together.success[i] == alone.success[0]


@pytest.mark.parametrize("action", [1e10, 1e200, np.inf, -np.inf, np.nan])
def test_a_return_that_overflows_is_clamped(action):
    actions = np.full((1, STEPS, 8), action)
    outcome = score(task(), frames(), actions, START[None], np.array([STEPS]), np.array([False]))
    returns, clamped = discounted(outcome.terms, 0.95, 0.1)
    assert (returns[0], clamped[0]) == (-1e12, True)


def test_touching():
    force = np.zeros((5, 3, 4))
    force[1, 0, 0], force[2, 2, 3], force[3] = 1e-9, 0.5, 2.0
    assert touching(force).tolist() == [False, True, True, True, False]
    assert touching(force[None]).shape == (1, 5)


unit = st.floats(-1, 1)


@given(
    angle=st.floats(0, math.pi),
    axis=st.tuples(unit, unit, unit),
    start=st.tuples(unit, unit, unit, unit),
)
def test_the_turn_is_the_angle_of_the_rotation_between(angle, axis, start):
    if np.linalg.norm(axis) < 0.1 or np.linalg.norm(start) < 0.1:
        return
    q, p = turned(angle, axis), np.asarray(start) / np.linalg.norm(start)
    product = np.concatenate(
        [[q[0] * p[0] - q[1:] @ p[1:]], q[0] * p[1:] + p[0] * q[1:] + np.cross(q[1:], p[1:])]
    )
    one, two = np.concatenate([np.ones(3), product]), np.concatenate([np.zeros(3), p])
    for first in (1, -1):
        for second in (1, -1):
            shift, turn = moved(one * [1, 1, 1, *[first] * 4], two * [1, 1, 1, *[second] * 4])
            assert turn == pytest.approx(angle, abs=1e-7)
            assert shift == pytest.approx(math.sqrt(3))


def test_nothing_moved():
    shift, turn = moved(START, START)
    assert shift == turn == 0.0
    slightly_long = START * [1, 1, 1, 1 + 1e-15, 1, 1, 1]
    assert moved(slightly_long, slightly_long)[1] == 0.0
