"""The task: what counts as success, what is observed, what is perturbed, and which settings make sense."""

import math
from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np
import pytest
from covering import any_two
from hypothesis import given
from hypothesis import strategies as st

from farm.errors import ConfigError
from farm.tasks.base import Record
from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.hand import GRIPS, TIP_RADIUS
from farm.tasks.finger_gait.holding import (
    CONTROL_PERIOD,
    MAX_SHIFT,
    MAX_TURN,
    PRESSES,
    moved,
    touching,
)
from farm.tasks.finger_gait.observations import Felt
from farm.tasks.finger_gait.sensing import DISPLACEMENT, Perturbation, SensingConfig
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.loop import discounted

STEPS = 15
START = np.array([0.08, 0.04, 0.02, 1.0, 0.0, 0.0, 0.0])


@dataclass
class Frames:
    """Measured moments."""

    qpos: np.ndarray
    force: np.ndarray
    place: np.ndarray

    def dict(self) -> dict[str, np.ndarray]:
        """As the loop has them: the fingertips' frames are the world's."""
        return {"qpos": self.qpos, **in_the_world(self.force, self.place)}


class Touched(FingerGait):
    """Measures what a test gives it."""

    def measure(self, sim):
        """The test's own."""
        return in_the_world(sim.force, sim.place)


def in_the_world(force, place):
    """Return what is measured of contacts at places in the fingertips' frames, which are the world's."""
    axes = np.broadcast_to(np.eye(3).ravel(), (*force.shape[:-1], 9))
    return {"force": force, "contact": place, "tip": np.zeros((*force.shape[:-1], 3)), "axes": axes}


def goal():
    rng = np.random.default_rng(0)
    return Felt(rng.uniform(0.3, 1.0, 8), rng.exponential(0.3, (3, 18)), rng.uniform(-0.5, 0.5, (3, 3)))


def task(**options):
    made = Touched(FingerGaitConfig(**options))
    made.goals, made.start_commands = [goal()], np.linspace(0.3, 1.0, 8)[None]
    return made


def frames(count=1, force=1.0, steps=STEPS):
    """Return frames of rollouts in which every fingertip presses at its pad and the object stays."""
    qpos = np.tile(np.concatenate([np.linspace(0.3, 1.0, 8), START]), (count, steps, 1))
    forces, place = np.zeros((count, steps, 3, 4)), np.zeros((count, steps, 3, 4, 3))
    forces[..., 0], place[..., 0, :] = force, [TIP_RADIUS, 0.0, 0.0]
    return Frames(qpos, forces, place)


def score(made, frames, actions, start, steps, failed):
    start = np.concatenate([np.zeros((len(start), 8)), start], axis=1)
    return made.score(Record(frames.dict(), {"qpos": start}, actions, steps, failed, np.zeros(len(steps), int)))


def judged(frames, steps=STEPS, failed=False, **options):
    count = len(frames.qpos)
    actions = np.zeros((count, frames.qpos.shape[1], 8))
    start = np.tile(START, (count, 1))
    return score(task(**options), frames, actions, start, np.full(count, steps), np.full(count, failed))


def observed(made, some, noise):
    sim = SimpleNamespace(qpos=some.qpos, force=some.force, place=some.place, t=0, own={"noise": noise[:, None]})
    return made.observe(sim)


def turned(angle, axis=(0.0, 0.0, 1.0)):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis])


# ---------------------------------------------------------------- success


def test_the_figures_of_the_criterion():
    assert PRESSES == 0.1
    assert MAX_SHIFT == 0.015
    assert pytest.approx(math.radians(30)) == MAX_TURN
    assert pytest.approx(0.1) == CONTROL_PERIOD


@pytest.mark.parametrize(*any_two(grip=GRIPS, finger=(0, 1, 2), step=(11, 12, 13, 14)))
def test_the_fingers_of_the_goal_and_no_others_press_at_each_of_the_last_three_steps(grip, finger, step):
    held, pressing = frames(), [name in GRIPS[grip] for name in ("index", "middle", "thumb")]
    held.force[:, :, np.logical_not(pressing)] = 0.0
    assert judged(held, goal_grip=grip).success[0]
    held.force[0, step, finger, 0] = 0.1 - 1e-9 if pressing[finger] else 0.1
    assert judged(held, goal_grip=grip).success[0] == (step < 12)


def test_a_tenth_of_a_newton_is_enough():
    assert judged(frames(force=0.1)).success[0]
    assert not judged(frames(force=math.nextafter(0.1, 0.0))).success[0]


def test_contacts_of_a_finger_press_together():
    held = frames(force=0.0)
    held.force[..., :2] = 0.06
    assert judged(held).success[0]


@pytest.mark.parametrize(*any_two(axis=(0, 1, 2), step=(11, 12, 13, 14), shift=(0.0149, -0.0149, 0.0151, -0.0151)))
def test_the_object_stays_within_15_millimetres(axis, step, shift):
    held = frames()
    held.qpos[0, step, 8 + axis] += shift
    assert judged(held).success[0] == (abs(shift) < 0.015 or step < 12)


def test_the_shift_is_a_distance_not_a_component():
    held = frames()
    held.qpos[0, -1, 8:11] += 0.009  # 15.6 mm away
    assert not judged(held).success[0]


AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 3))


@pytest.mark.parametrize(*any_two(axis=AXES, step=(11, 12, 13, 14), degrees=(29.9, -29.9, 30.1, -30.1)), ids=str)
def test_the_object_turns_less_than_30_degrees(axis, step, degrees):
    held = frames()
    held.qpos[0, step, 11:] = turned(math.radians(degrees), axis)
    assert judged(held).success[0] == (abs(degrees) < 30 or step < 12)
    held.qpos[0, step, 11:] *= -1
    assert judged(held).success[0] == (abs(degrees) < 30 or step < 12)


def test_the_pose_is_compared_with_that_at_release():
    held = frames()
    held.qpos[..., 8:11] += 0.1
    held.qpos[..., 11:] = turned(1.0)
    start = held.qpos[:, 0, 8:]
    outcome = score(task(), held, np.zeros((1, STEPS, 8)), start, np.array([STEPS]), np.array([False]))
    assert outcome.success[0]
    assert not judged(held).success[0]


@pytest.mark.parametrize("steps", [1, 12, 15])
def test_a_dropped_object_is_no_success(steps):
    held = frames()
    held.force[0, steps - 1] = 0.0
    outcome = judged(held, steps=steps)
    assert not outcome.success[0]
    assert outcome.terms[0, steps - 1, 4] == -400


@pytest.mark.parametrize("steps", [1, 15])
@pytest.mark.parametrize("force", [0.0, 1.0])
def test_a_failed_rollout_gives_the_penalty_alone(steps, force):
    outcome = judged(frames(force=force), steps=steps, failed=True)
    assert not outcome.success[0]
    assert outcome.terms[0, steps - 1].tolist() == [0, 0, 0, 0, -400]


def test_a_success_on_the_way_that_does_not_last_is_none():
    held = frames()
    held.force[0, 13:, 1] = 0.0
    assert not judged(held).success[0]


def test_success_is_judged_at_the_end_of_longer_rollouts_too():
    held = frames(steps=40)
    assert judged(held, steps=40).success[0]
    held.force[0, 37, 0] = 0.0
    assert not judged(held, steps=40).success[0]


def test_rollouts_of_a_batch_are_judged_apart():
    rng = np.random.default_rng(1)
    many = frames(6)
    many.force[:] = rng.exponential(0.3, many.force.shape) * (rng.random(many.force.shape) < 0.8)
    many.place[:] = rng.normal(size=many.place.shape) * TIP_RADIUS
    actions, failed = rng.normal(size=(6, STEPS, 8)), np.array([0, 0, 1, 0, 0, 1], dtype=bool)
    steps, start = np.array([15, 15, 4, 9, 15, 15]), np.tile(START, (6, 1))
    made = task()
    together = score(made, many, actions, start, steps, failed)
    for i in range(6):
        row = slice(i, i + 1)
        own = Frames(many.qpos[row], many.force[row], many.place[row])
        alone = score(made, own, actions[row], start[row], steps[row], failed[row])
        assert together.terms[i].tobytes() == alone.terms[0].tobytes()
        assert together.success[i] == alone.success[0]


@pytest.mark.parametrize("action", [1e10, 1e200, np.inf, -np.inf, np.nan])
def test_a_return_that_overflows_is_clamped(action):
    actions = np.full((1, STEPS, 8), action)
    outcome = score(task(), frames(), actions, START[None], np.array([STEPS]), np.array([False]))
    returns, clamped = discounted(outcome.terms, 0.95, 0.1)
    assert (returns[0], clamped[0]) == (-1e12, True)


# ---------------------------------------------------------------- touching and moving


def test_touching():
    force = np.zeros((5, 3, 4))
    force[1, 0, 0], force[2, 2, 3], force[3] = 1e-9, 0.5, 2.0
    assert touching(force).tolist() == [False, True, True, True, False]
    assert touching(force[None]).shape == (1, 5)


unit = st.floats(-1, 1)


@given(angle=st.floats(0, math.pi), axis=st.tuples(unit, unit, unit), start=st.tuples(unit, unit, unit, unit))
def test_the_turn_is_the_angle_of_the_rotation_between(angle, axis, start):
    if np.linalg.norm(axis) < 0.1 or np.linalg.norm(start) < 0.1:
        return
    q, p = turned(angle, axis), np.asarray(start) / np.linalg.norm(start)
    product = np.concatenate([[q[0] * p[0] - q[1:] @ p[1:]], q[0] * p[1:] + p[0] * q[1:] + np.cross(q[1:], p[1:])])
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


# ---------------------------------------------------------------- what is observed


def some_frames(count=4, seed=5):
    rng = np.random.default_rng(seed)
    force = rng.exponential(1.0, (count, 3, 4)) * (rng.random((count, 3, 4)) < 0.5)
    place = rng.normal(size=(count, 3, 4, 3)) * TIP_RADIUS
    return Frames(rng.uniform(0, 1, (count, 15)), force, place)


@pytest.mark.parametrize("state", ["joints", "joints+contacts", "tactile", "joints+tactile"])
def test_observations_are_scaled_part_by_part(state):
    some = some_frames()
    noise = np.random.default_rng(1).normal(size=(4, 8))
    scaled = observed(task(state=state, joints_scale=2.0, contacts_scale=3.0, tactile_scale=5.0), some, noise)
    images = tactile.image(some.force, some.place)
    parts = {
        "joints": 2.0 * (some.qpos[:, :8] + noise),
        "contacts": 3.0 * tactile.contact_points(images).reshape(4, 9),
        "tactile": 5.0 * images.reshape(4, 54),
    }
    np.testing.assert_allclose(scaled, np.concatenate([parts[part] for part in state.split("+")], axis=1), rtol=1e-12)


@pytest.mark.parametrize("state", ["joints", "joints+contacts", "tactile", "joints+tactile"])
def test_noise_is_in_the_joint_readings_only(state):
    some = some_frames()
    before = some.qpos.copy()
    noise = np.random.default_rng(1).normal(size=(4, 8))
    made = task(state=state)
    quiet, noisy = observed(made, some, np.zeros((4, 8))), observed(made, some, noise)
    count = 8 if state.startswith("joints") else 0
    np.testing.assert_array_equal(noisy[:, count:], quiet[:, count:])
    np.testing.assert_allclose(noisy[:, :count] - quiet[:, :count], noise[:, :count], atol=1e-15)
    np.testing.assert_array_equal(some.qpos, before)


@pytest.mark.parametrize("state", ["joints", "joints+contacts", "tactile", "joints+tactile"])
def test_observations_of_a_batch_equal_one_by_one_bit_for_bit(state):
    some = some_frames(32)
    noise = np.random.default_rng(1).normal(size=(32, 8))
    made = task(state=state, tactile_scale=0.3)
    x = observed(made, some, noise)
    for i in range(32):
        own = Frames(some.qpos[i : i + 1], some.force[i : i + 1], some.place[i : i + 1])
        alone = observed(made, own, noise[i : i + 1])
        assert alone[0].tobytes() == x[i].tobytes()


# ---------------------------------------------------------------- perturbations

ORACLE = {
    "friction": 1.1868755400377755,
    "mass": 0.9358703521697765,
    "displacement": [-0.000977337657837836, -0.0003862596859837662, 0.000796141017884563],
    "noise": [-0.005056647507339969, -0.009166622744730677, 0.0001734221675778827],
}
"""First numbers of seed 2016."""


def test_the_numbers_drawn_for_a_seed_never_change():
    drawn = Perturbation.draw(np.random.default_rng(2016), STEPS, SensingConfig())
    assert drawn.friction == ORACLE["friction"]
    assert drawn.mass == ORACLE["mass"]
    assert drawn.displacement.tolist() == ORACLE["displacement"]
    assert drawn.noise[0, :3].tolist() == ORACLE["noise"]


def test_the_same_seed_draws_the_same():
    errors, seeds = SensingConfig(force_noise=0.1, force_dropout=0.5), ([1, 2], [1, 2], [1, 3])
    one, two, other = (Perturbation.draw(np.random.default_rng(seed), STEPS, errors) for seed in seeds)
    for field in fields(Perturbation):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
        assert np.any(getattr(one, field.name) != getattr(other, field.name))


@pytest.mark.parametrize("steps", [3, 40])
def test_the_order_of_draws_is_friction_mass_displacement_noise(steps):
    rng = np.random.default_rng(4)
    expected = (
        rng.uniform(0.8, 1.2),
        rng.uniform(0.8, 1.2),
        rng.uniform(-0.002, 0.002, 3),
        rng.normal(0, 0.01, (steps, 8)),
    )
    drawn = Perturbation.draw(np.random.default_rng(4), steps, SensingConfig())
    for name, wanted in zip(("friction", "mass", "displacement", "noise"), expected, strict=True):
        np.testing.assert_array_equal(getattr(drawn, name), wanted)


def test_draws_fill_their_ranges():
    rng = np.random.default_rng(0)
    drawn = [Perturbation.draw(rng, STEPS, SensingConfig()) for _ in range(500)]
    for values in ([p.friction for p in drawn], [p.mass for p in drawn]):
        assert 0.8 <= min(values) < 0.81
        assert 1.19 < max(values) <= 1.2
    places = np.stack([p.displacement for p in drawn])
    assert np.abs(places).max() <= DISPLACEMENT == 0.002
    assert (places.max(axis=0) > 0.0019).all()
    assert (places.min(axis=0) < -0.0019).all()
    noise = np.stack([p.noise for p in drawn])
    assert noise.shape == (500, STEPS, 8)
    assert noise.std() == pytest.approx(0.01, rel=0.02)
    assert abs(noise.mean()) < 1e-4


# ---------------------------------------------------------------- configuration

UNKNOWN = {
    "start_grip": "index\\+thumb, middle\\+thumb, index\\+middle\\+thumb",
    "goal_grip": "index\\+thumb, middle\\+thumb, index\\+middle\\+thumb",
    "state": "joints, joints\\+contacts, tactile, joints\\+tactile",
    "reward": "basic, full",
    "weights": "direct, projected",
}


@pytest.mark.parametrize("field", UNKNOWN)
def test_an_unknown_name_answers_with_the_known_ones(field):
    with pytest.raises(ConfigError, match=f"unknown .*'nothing'; known are {UNKNOWN[field]}"):
        FingerGaitConfig(**{field: "nothing"})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("steps", value) for value in (-1, 2, 1001)),
        *(("gamma", value) for value in (0.0, -0.5, 1.0000001, math.nan, math.inf)),
        *(("joints_scale", value) for value in (0.0, -1.0, math.inf, math.nan)),
        *(("contacts_scale", value) for value in (0.0, math.inf)),
        *(("tactile_scale", value) for value in (0.0, math.nan)),
    ],
)
def test_a_number_out_of_range_is_named(field, value):
    with pytest.raises(ConfigError, match=f"^{field.replace('_', '-')} is {value}; expected"):
        FingerGaitConfig(**{field: value})


@pytest.mark.parametrize(("field", "value"), [("steps", 3), ("steps", 1000), ("gamma", 1.0), ("gamma", 1e-9)])
def test_a_number_at_the_edge_is_taken(field, value):
    assert getattr(FingerGaitConfig(**{field: value}), field) == value


def test_the_defaults_are_those_of_the_thesis():
    config = FingerGaitConfig()
    assert (config.object, config.start_grip, config.goal_grip) == ("bar", "index+thumb", "index+middle+thumb")
    assert (config.state, config.reward, config.weights) == ("joints", "full", "projected")
    assert (FingerGait(config).steps, config.gamma, config.perturb) == (15, 0.95, False)
    assert (config.action, config.clip) == ("offset", True)
    assert config.joints_scale == config.contacts_scale == config.tactile_scale == 1.0
