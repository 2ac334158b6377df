"""Rewards and return compared with equations 3.3 to 3.5 of the thesis in plain Python."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from farm.returns import RETURN_FLOOR
from farm.tasks.finger_gait.hand import LOWER, UPPER
from farm.tasks.finger_gait.observations import Felt
from farm.tasks.finger_gait.rewards import RETURN_SCALE, REWARDS, TERMS, WEIGHTS, end
from farm.tasks.rollouts import discounted as _discounted

STEPS = 15


def discounted(terms, gamma, scale=RETURN_SCALE):
    return _discounted(terms, gamma, scale)


def rewarded(name, joints, images, points, action, goal, row):
    return REWARDS[name](Felt(joints, images, points), action, goal, WEIGHTS[row])


# ---------------------------------------------------------------- Table 3.1 and numbers by hand


def test_weights_are_those_of_table_3_1():
    # Ranges of the joints [rad]: 1.806, 1.883, 1.845 for index and middle, 1.833, 1.881 for the
    # thumb.
    squares = 2 * (1.806**2 + 1.883**2 + 1.845**2) + 1.833**2 + 1.881**2
    mean = (2 * (1.806 + 1.883 + 1.845) + 1.833 + 1.881) / 8
    direct, projected = WEIGHTS["direct"], WEIGHTS["projected"]
    assert (direct.tactile, direct.joints, direct.contact_points, direct.drop) == (1, 30, 1, 1000)
    assert (projected.tactile, projected.joints, projected.contact_points, projected.drop) == (
        0.1,
        6,
        6,
        400,
    )
    assert (
        direct.action == pytest.approx(10 / squares, rel=1e-12) == pytest.approx(0.366022, abs=1e-6)
    )
    assert (
        projected.action == pytest.approx(1 / mean, rel=1e-12) == pytest.approx(0.541199, abs=1e-6)
    )
    assert list(WEIGHTS) == ["direct", "projected"]


def example():
    """Return q, c, CP, a and the demonstration of an example small enough to compute by hand."""
    goal = Felt(joints=np.ones(8), images=np.zeros((3, 18)), points=np.zeros((3, 3)))
    goal.images[0, 4], goal.images[2, 17] = 2.0, 1.0  # c_d'c_d = 5
    goal.points[1] = 0.1, 0.2, 0.3
    joints = np.full(8, 1.1)  # |q_d - q|^2 = 0.08, q_d'q_d = 8
    images = goal.images.copy()
    images[1, 0] = 1.0  # |c_d - c|^2 = 1
    points = goal.points.copy()
    points[1] += 0.3, 0.0, -0.4  # |CP - CP_d|^2 = 0.25
    return joints, images, points, np.full(8, -0.5), goal  # a'a = 2


@pytest.mark.parametrize(
    ("reward", "row", "expected"),
    [
        ("full", "direct", [-0.2, -0.3, -0.7320443, -0.25, 0]),
        ("full", "projected", [-0.02, -0.06, -1.0823975, -1.5, 0]),
        ("basic", "direct", [0, -0.3, -0.7320443, 0, 0]),
        ("basic", "projected", [0, -0.06, -1.0823975, 0, 0]),
    ],
)
def test_an_example_by_hand(reward, row, expected):
    terms = rewarded(reward, *example(), row)
    assert len(TERMS) == 5
    np.testing.assert_allclose(terms, expected, rtol=1e-6, atol=1e-15)


def test_the_demonstration_itself_costs_nothing():
    goal = example()[-1]
    for reward in REWARDS.values():
        terms = reward(goal, np.zeros(8), goal, WEIGHTS["direct"])
        assert not terms.any()


# ---------------------------------------------------------------- a slow reading


def slow_full(q, c, cp, a, goal, weights):
    """Equation 3.5 without the penalty, part by part."""
    touch = squares = 0.0
    for finger in range(3):
        for taxel in range(18):
            touch += (goal.images[finger, taxel] - c[finger, taxel]) ** 2
            squares += goal.images[finger, taxel] ** 2
    joints = sum((goal.joints[i] - q[i]) ** 2 for i in range(8)) / sum(
        goal.joints[i] ** 2 for i in range(8)
    )
    action = sum(a[i] ** 2 for i in range(8))
    points = 0.0
    for finger in range(3):
        points += sum((cp[finger, k] - goal.points[finger, k]) ** 2 for k in range(3))
    return [
        -weights.tactile * touch / squares,
        -weights.joints * joints,
        -weights.action * action,
        -weights.contact_points * points,
        0.0,
    ]


def slow_basic(q, c, cp, a, goal, weights):
    """Equation 3.3 with W_q = a2 / (q_d'q_d) I and W_a = a3 I."""
    _, joints, action, _, _ = slow_full(q, c, cp, a, goal, weights)
    return [0.0, joints, action, 0.0, 0.0]


SLOW = {"basic": slow_basic, "full": slow_full}


def rollouts(count, seed=0):
    rng = np.random.default_rng(seed)
    shape = (count, STEPS)
    goal = Felt(
        rng.normal(1, 0.3, 8), rng.exponential(0.3, (3, 18)), rng.uniform(-0.5, 0.5, (3, 3))
    )
    return (
        rng.normal(1, 0.3, (*shape, 8)),
        rng.exponential(0.3, (*shape, 3, 18)),
        rng.uniform(-0.5, 0.5, (*shape, 3, 3)),
        rng.normal(0, 0.5, (*shape, 8)),
        goal,
    )


@pytest.mark.parametrize("row", list(WEIGHTS))
@pytest.mark.parametrize("name", list(SLOW))
def test_every_step_of_every_rollout_is_as_written(name, row):
    *values, goal = rollouts(4)
    terms = rewarded(name, *values, goal, row)
    assert terms.shape == (4, STEPS, 5)
    for i in range(4):
        for t in range(STEPS):
            expected = SLOW[name](*(value[i, t] for value in values), goal, WEIGHTS[row])
            np.testing.assert_allclose(terms[i, t], expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", list(REWARDS))
@pytest.mark.parametrize("count", [1, 2, 7, 32])
def test_a_batch_equals_one_by_one_bit_for_bit(name, count):
    *values, goal = rollouts(count)
    terms = rewarded(name, *values, goal, "projected")
    returns, _ = discounted(terms, 0.95)
    for i in range(count):
        alone = rewarded(name, *(value[i : i + 1] for value in values), goal, "projected")
        assert alone.tobytes() == terms[i].tobytes()
        assert discounted(alone, 0.95)[0].tobytes() == returns[i].tobytes()


# ---------------------------------------------------------------- the end of a rollout


def ended(steps, dropped=False, failed=False, seed=0, row="projected"):
    """Return terms of one rollout before and after its end was cut."""
    terms = -np.random.default_rng(seed).exponential(1.0, (1, STEPS, 5))
    terms[..., 4] = 0.0
    cut = end(terms, np.array([steps]), np.array([dropped]), np.array([failed]), WEIGHTS[row])
    return terms[0], cut[0]


@pytest.mark.parametrize("row", list(WEIGHTS))
@pytest.mark.parametrize("steps", [1, 2, 8, 14, 15])
def test_a_drop_is_punished_once_at_its_step(steps, row):
    terms, cut = ended(steps, dropped=True, row=row)
    np.testing.assert_array_equal(cut[:steps, :4], terms[:steps, :4])
    assert not cut[: steps - 1, 4].any()
    assert cut[steps - 1, 4] == {"direct": -1000, "projected": -400}[row]
    assert not cut[steps:].any()


@pytest.mark.parametrize("steps", [1, 2, 8, 14, 15])
def test_a_failed_rollout_gives_the_penalty_alone_at_its_step(steps):
    terms, cut = ended(steps, failed=True)
    np.testing.assert_array_equal(cut[: steps - 1], terms[: steps - 1])
    assert cut[steps - 1].tolist() == [0, 0, 0, 0, -400]
    assert not cut[steps:].any()


def test_a_rollout_that_lasts_is_left_alone():
    terms, cut = ended(STEPS)
    np.testing.assert_array_equal(cut, terms)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_of_a_failed_step_and_after_go_nowhere(bad):
    terms = np.zeros((1, STEPS, 5))
    terms[0, 3:, :4] = bad
    cut = end(terms, np.array([4]), np.array([False]), np.array([True]), WEIGHTS["direct"])
    assert cut[0, 3].tolist() == [0, 0, 0, 0, -1000]
    returns, clamped = discounted(cut, 0.95)
    assert returns[0] == pytest.approx(-100 * 0.95**3)
    assert not clamped[0]


def test_ends_of_a_batch_do_not_meet():
    terms = -np.ones((4, STEPS, 5)) * [1, 1, 1, 1, 0]
    steps = np.array([15, 3, 15, 7])
    dropped, failed = np.array([False, True, True, False]), np.array([False, False, False, True])
    cut = end(terms, steps, dropped, failed, WEIGHTS["projected"])
    for i in range(4):
        alone = end(
            terms[i : i + 1],
            steps[i : i + 1],
            dropped[i : i + 1],
            failed[i : i + 1],
            WEIGHTS["projected"],
        )
        np.testing.assert_array_equal(cut[i], alone[0])
    assert cut[..., 4].tolist() == [
        [0] * 15,
        [0, 0, -400] + [0] * 12,
        [0] * 14 + [-400],
        [0] * 6 + [-400] + [0] * 8,
    ]
    assert (terms[..., :4] == -1).all()  # what went in is as it was


# ---------------------------------------------------------------- the return


def test_the_return_is_a_tenth_of_fifteen_discounted_terms():
    terms = np.zeros((1, STEPS, 5))
    terms[..., 1] = -1.0
    returns, clamped = discounted(terms, 0.95)
    assert returns[0] == pytest.approx(-0.1 * (1 - 0.95**15) / (1 - 0.95), rel=1e-12)
    assert returns[0] == pytest.approx(-1.0734175, abs=1e-6)
    assert not clamped[0]


@pytest.mark.parametrize("t", range(STEPS))
def test_every_step_weighs_gamma_to_the_t(t):
    terms = np.zeros((1, STEPS, 5))
    terms[0, t] = [-1, -2, -3, -4, -400]
    assert discounted(terms, 0.95)[0][0] == pytest.approx(-41.0 * math.pow(0.95, t), rel=1e-12)


@given(gamma=st.floats(0.01, 1.0), seed=st.integers(0, 100))
def test_the_return_is_as_written(gamma, seed):
    terms = -np.random.default_rng(seed).exponential(1.0, (3, STEPS, 5))
    returns, clamped = discounted(terms, gamma)
    for i in range(3):
        slow = 0.0
        for t in range(STEPS):
            slow += gamma**t * sum(terms[i, t])
        assert returns[i] == pytest.approx(0.1 * slow, rel=1e-12)
    assert not clamped.any()


@pytest.mark.parametrize(
    ("value", "expected", "flag"),
    [
        (-np.inf, RETURN_FLOOR, True),
        (np.nan, RETURN_FLOOR, True),
        (-1e308, RETURN_FLOOR, True),
        (-1e14, RETURN_FLOOR, True),
        (-1e13, -1e12, False),
        (-1e10, -1e9, False),
    ],
)
def test_an_overflow_is_clamped_and_flagged(value, expected, flag):
    terms = np.zeros((2, STEPS, 5))
    terms[0, 0, 2] = value
    returns, clamped = discounted(terms, 0.95)
    assert returns[0] == pytest.approx(expected)
    assert clamped.tolist() == [flag, False]
    assert returns[1] == 0.0


def test_opposite_infinities_are_clamped():
    terms = np.zeros((1, STEPS, 5))
    terms[0, 0, 0], terms[0, 1, 0] = np.inf, -np.inf
    assert discounted(terms, 0.95)[0][0] == RETURN_FLOOR == -1e12


def test_the_limited_reward_punishes_no_action_beyond_its_range() -> None:
    joints, images, points = np.zeros(8), np.zeros((3, 18)), np.zeros((3, 3))
    goal = Felt(np.ones(8), np.ones((3, 18)), np.ones((3, 3)))
    ranges = UPPER - LOWER
    for action in (0.5 * ranges, ranges, -ranges):
        assert np.array_equal(
            *(
                rewarded(name, joints, images, points, action, goal, "direct")
                for name in ("full", "limited")
            )
        )
    huge = rewarded("limited", joints, images, points, np.full(8, -1e200), goal, "direct")
    assert huge[2] == pytest.approx(-WEIGHTS["direct"].action * ranges @ ranges) == -10.0


def test_the_scale_of_the_return() -> None:
    terms = np.random.default_rng(0).normal(size=(4, 15, 5))
    returns, _ = discounted(terms, 0.95, 0.125)
    assert np.array_equal(discounted(terms, 0.95, 8.0)[0], 64 * returns)
