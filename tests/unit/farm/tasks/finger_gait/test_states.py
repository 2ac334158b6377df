"""The four state bases: sizes, the order of their parts, scales and noise, and independence of
rows.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from gait import Frames, task

from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.hand import TIP_RADIUS
from farm.tasks.finger_gait.observations import STATES, Felt

SIZES = {"joints": 8, "joints+contacts": 17, "tactile": 54, "joints+tactile": 62}


def parts(count=3):
    """Joints, images and contact points whose every number tells where it stood."""
    joints = np.arange(count * 8.0).reshape(count, 8)
    images = 1000.0 + np.arange(count * 54.0).reshape(count, 3, 18)
    points = -1000.0 - np.arange(count * 9.0).reshape(count, 3, 3)
    return joints, images, points


def test_there_are_the_four_of_the_thesis_two_of_forces_and_one_of_deflections():
    assert {name: state.size for name, state in STATES.items()} == {
        **SIZES,
        "forces": 3,
        "cop": 12,
        "zeroed": 8,
    }
    assert {name for name, state in STATES.items() if not state.touch} == {"joints", "zeroed"}


@pytest.mark.parametrize("name", SIZES)
def test_parts_stand_in_the_order_of_the_name(name):
    joints, images, points = parts()
    x = STATES[name].observe(Felt(joints, images, points))
    assert x.shape == (3, SIZES[name])
    for row in range(3):
        expected = {
            "joints": [*joints[row]],
            "joints+contacts": [*joints[row], *points[row, 0], *points[row, 1], *points[row, 2]],
            "tactile": [*images[row, 0], *images[row, 1], *images[row, 2]],
            "joints+tactile": [*joints[row], *images[row, 0], *images[row, 1], *images[row, 2]],
        }[name]
        assert x[row].tolist() == expected


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("count", [1, 2, 32])
def test_rows_are_independent(name, count):
    joints, images, points = parts(count)
    x = STATES[name].observe(Felt(joints, images, points))
    for row in range(count):
        alone = STATES[name].observe(
            Felt(joints[row : row + 1], images[row : row + 1], points[row : row + 1])
        )
        assert alone[0].tobytes() == x[row].tobytes()


def test_forces_are_what_the_taxels_add_up_to():
    joints, images, points = parts()
    felt = Felt(joints, images, points)
    np.testing.assert_array_equal(STATES["forces"].observe(felt), images.sum(axis=-1))
    np.testing.assert_array_equal(
        STATES["cop"].observe(felt),
        np.concatenate([points.reshape(len(joints), -1), images.sum(axis=-1)], axis=1),
    )


def some_frames(count=4, seed=5):
    rng = np.random.default_rng(seed)
    force = rng.exponential(1.0, (count, 3, 4)) * (rng.random((count, 3, 4)) < 0.5)
    place = rng.normal(size=(count, 3, 4, 3)) * TIP_RADIUS
    return Frames(rng.uniform(0, 1, (count, 15)), force, place)


def observed(gait, frames, noise):
    sim = SimpleNamespace(
        qpos=frames.qpos, force=frames.force, place=frames.place, t=0, own={"noise": noise[:, None]}
    )
    return gait.observe(sim)


@pytest.mark.parametrize("state", SIZES)
def test_observations_are_scaled_part_by_part(state):
    frames = some_frames()
    noise = np.random.default_rng(1).normal(size=(4, 8))
    scaled = observed(
        task(state=state, joints_scale=2.0, contacts_scale=3.0, tactile_scale=5.0), frames, noise
    )
    images = tactile.image(frames.force, frames.place)
    expected = {
        "joints": 2.0 * (frames.qpos[:, :8] + noise),
        "contacts": 3.0 * tactile.contact_points(images).reshape(4, 9),
        "tactile": 5.0 * images.reshape(4, 54),
    }
    np.testing.assert_allclose(
        scaled, np.concatenate([expected[part] for part in state.split("+")], axis=1), rtol=1e-12
    )


@pytest.mark.parametrize("state", SIZES)
def test_noise_is_in_the_joint_readings_only(state):
    frames = some_frames()
    before = frames.qpos.copy()
    noise = np.random.default_rng(1).normal(size=(4, 8))
    gait = task(state=state)
    quiet, noisy = observed(gait, frames, np.zeros((4, 8))), observed(gait, frames, noise)
    count = 8 if state.startswith("joints") else 0
    np.testing.assert_array_equal(noisy[:, count:], quiet[:, count:])
    np.testing.assert_allclose(noisy[:, :count] - quiet[:, :count], noise[:, :count], atol=1e-15)
    np.testing.assert_array_equal(frames.qpos, before)


@pytest.mark.parametrize("state", SIZES)
def test_observations_of_a_batch_equal_one_by_one_bit_for_bit(state):
    frames = some_frames(32)
    noise = np.random.default_rng(1).normal(size=(32, 8))
    gait = task(state=state, tactile_scale=0.3)
    x = observed(gait, frames, noise)
    for i in range(32):
        single = Frames(frames.qpos[i : i + 1], frames.force[i : i + 1], frames.place[i : i + 1])
        alone = observed(gait, single, noise[i : i + 1])
        assert alone[0].tobytes() == x[i].tobytes()
