"""The four state bases: sizes, the order of their parts, and independence of rows."""

import numpy as np
import pytest

from farm.tasks.finger_gait.observations import STATES, Felt

SIZES = {"joints": 8, "joints+contacts": 17, "tactile": 54, "joints+tactile": 62}


def parts(count=3):
    """Joints, images and contact points whose every number tells where it stood."""
    joints = np.arange(count * 8.0).reshape(count, 8)
    images = 1000.0 + np.arange(count * 54.0).reshape(count, 3, 18)
    points = -1000.0 - np.arange(count * 9.0).reshape(count, 3, 3)
    return joints, images, points


def test_there_are_the_four_of_the_thesis_two_of_forces_and_one_of_deflections():
    assert {name: state.size for name, state in STATES.items()} == {**SIZES, "forces": 3, "cop": 12, "zeroed": 8}
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
        alone = STATES[name].observe(Felt(joints[row : row + 1], images[row : row + 1], points[row : row + 1]))
        assert alone[0].tobytes() == x[row].tobytes()


def test_forces_are_what_the_taxels_add_up_to():
    joints, images, points = parts()
    felt = Felt(joints, images, points)
    np.testing.assert_array_equal(STATES["forces"].observe(felt), images.sum(axis=-1))
    np.testing.assert_array_equal(
        STATES["cop"].observe(felt), np.concatenate([points.reshape(len(joints), -1), images.sum(axis=-1)], axis=1)
    )
