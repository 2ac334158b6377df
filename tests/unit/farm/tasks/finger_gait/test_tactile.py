"""Touch: positions of the taxels, the spread of a contact over them, and the contact point computed
back.
"""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from farm.tasks.finger_gait import touch as tactile
from farm.tasks.finger_gait.hand import TIP_RADIUS

MIDDLE = np.array([math.sin(tactile.TILT), 0.0, math.cos(tactile.TILT)])
"""Where the half sphere looks."""


def direction(pitch, across):
    """Unit vector at angles [rad] from the middle of the half sphere: in the finger's plane, and
    across it.
    """
    angle = pitch + tactile.TILT
    return np.array(
        [math.cos(across) * math.sin(angle), math.sin(across), math.cos(across) * math.cos(angle)]
    )


def touch(*contacts):
    """Image (18,) of contacts (force, direction)."""
    forces, places = np.zeros(4), np.zeros((4, 3))
    for i, (force, where) in enumerate(contacts):
        forces[i], places[i] = force, np.asarray(where) * TIP_RADIUS
    return tactile.image(forces, places)


def mirrored(image):
    return image.reshape(6, 3)[:, ::-1].reshape(18)


half_sphere = st.builds(
    direction,
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(-math.pi / 2, math.pi / 2),
)
forces = st.floats(1e-3, 50.0)
contacts = st.lists(st.tuples(forces, half_sphere), min_size=1, max_size=4)


def test_there_are_six_rows_of_three():
    assert tactile.SHAPE == (6, 3)
    assert tactile.TAXELS == 18
    assert tactile.DIRECTIONS.shape == tactile.positions().shape == (18, 3)


def test_taxels_lie_on_the_half_sphere():
    np.testing.assert_allclose(np.linalg.norm(tactile.positions(), axis=1), TIP_RADIUS, rtol=1e-12)
    assert (tactile.DIRECTIONS @ MIDDLE >= 0).all()
    assert len(np.unique(tactile.DIRECTIONS.round(6), axis=0)) == 18


def test_the_layout_is_as_described():
    grid = tactile.DIRECTIONS.reshape(6, 3, 3)
    assert (grid[:, 0, 1] < 0).all()
    assert (grid[:, 1, 1] == 0).all()
    assert (grid[:, 2, 1] > 0).all()
    assert grid[0, 1, 0] < 0 < grid[-1, 1, 0]  # from the finger's back, -x, to its pad, +x
    assert (np.diff(np.arctan2(grid[:, 1, 0], grid[:, 1, 2])) > 0).all()
    np.testing.assert_allclose(
        grid.reshape(18, 3).mean(axis=0)[[0, 2]] @ [MIDDLE[2], -MIDDLE[0]], 0.0, atol=1e-12
    )


def test_the_taxels_are_not_to_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        tactile.DIRECTIONS[0] = 0.0


@given(force=forces, where=half_sphere)
def test_a_mirrored_contact_gives_the_mirrored_image(force, where):
    image = touch((force, where))
    np.testing.assert_allclose(touch((force, where * [1, -1, 1])), mirrored(image), rtol=1e-12)


def test_a_contact_in_the_finger_plane_gives_a_symmetric_image():
    image = touch((2.0, direction(0.3, 0.0)))
    np.testing.assert_allclose(image, mirrored(image), rtol=1e-12)


@given(contacts=contacts)
def test_the_total_is_kept(contacts):
    image = touch(*contacts)
    assert (image > 0).all()
    assert image.sum() == pytest.approx(sum(force for force, _ in contacts), rel=1e-12)


@given(force=forces, where=half_sphere)
def test_the_nearest_taxel_feels_most(force, where):
    near = np.argsort(tactile.DIRECTIONS @ where)
    gap = tactile.DIRECTIONS[near[-1]] @ where - tactile.DIRECTIONS[near[-2]] @ where
    assume(gap > 1e-9)
    image = touch((force, where))
    assert image.argmax() == near[-1]
    felt = image[near]
    assert (np.diff(felt) >= -1e-12 * felt.max()).all()  # and less, the farther away


def test_a_contact_on_a_taxel_spreads_as_written():
    for i, where in enumerate(tactile.DIRECTIONS):
        cosines = [
            sum(a * b for a, b in zip(where, other, strict=True)) for other in tactile.DIRECTIONS
        ]
        weights = [math.exp(8.0 * (cosine - 1.0)) for cosine in cosines]
        expected = [3.0 * weight / sum(weights) for weight in weights]
        image = touch((3.0, where))
        np.testing.assert_allclose(image, expected, rtol=1e-12)
        assert image.argmax() == i


@given(contacts=contacts)
def test_contacts_superpose(contacts):
    alone = sum(touch(contact) for contact in contacts)
    np.testing.assert_allclose(touch(*contacts), alone, rtol=1e-12)


@given(force=forces, where=half_sphere, factor=st.floats(0.5, 2.0))
def test_only_the_direction_of_the_place_counts(force, where, factor):
    np.testing.assert_allclose(touch((force, where * factor)), touch((force, where)), rtol=1e-12)
    np.testing.assert_allclose(
        touch((force * factor, where)), touch((force, where)) * factor, rtol=1e-12
    )


@given(force=forces, where=half_sphere)
def test_the_contact_point_of_one_contact_points_to_it(force, where):
    point = tactile.contact_points(touch((force, where)))
    assert np.linalg.norm(point) <= 1.0
    # The spread and the sphere's edge pull it inwards, no farther than the taxels reach.
    assert point @ where / np.linalg.norm(point) > math.cos(math.radians(35.0))


def test_the_contact_point_is_the_centre_of_force():
    image = np.zeros(18)
    image[4], image[7] = 1.0, 3.0
    expected = 0.25 * tactile.DIRECTIONS[4] + 0.75 * tactile.DIRECTIONS[7]
    np.testing.assert_allclose(tactile.contact_points(image), expected, rtol=1e-12)


@given(contacts=contacts)
def test_contact_points_stay_in_the_unit_ball_whatever_the_force(contacts):
    point = tactile.contact_points(touch(*contacts))
    assert np.linalg.norm(point) <= 1.0
    np.testing.assert_allclose(
        tactile.contact_points(1e-300 * touch(*contacts)), point, rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("place", [np.zeros(3), MIDDLE * TIP_RADIUS], ids=["no place", "a place"])
def test_no_contact_is_zero(place):
    image = tactile.image(np.zeros(4), np.tile(place, (4, 1)))
    assert not image.any()
    assert not tactile.contact_points(image).any()
    assert image.shape == (18,)


def test_a_contact_at_the_centre_is_spread_evenly():
    np.testing.assert_allclose(tactile.image(np.array([1.8]), np.zeros((1, 3))), 0.1, rtol=1e-12)


def random_contacts(shape, seed=0):
    rng = np.random.default_rng(seed)
    force = np.where(rng.random((*shape, 3, 4)) < 0.5, rng.exponential(2.0, (*shape, 3, 4)), 0.0)
    place = rng.normal(size=(*shape, 3, 4, 3))
    return force, TIP_RADIUS * place / np.linalg.norm(place, axis=-1, keepdims=True)


@pytest.mark.parametrize("shape", [(1,), (2,), (7,), (32,), (64,), (5, 15), (1, 150)], ids=str)
def test_a_batch_equals_one_by_one_bit_for_bit(shape):
    force, place = random_contacts(shape)
    images = tactile.image(force, place)
    points = tactile.contact_points(images)
    assert images.shape == (*shape, 3, 18)
    assert points.shape == (*shape, 3, 3)
    for index in np.ndindex(*shape, 3):
        image = tactile.image(force[index], place[index])
        assert image.tobytes() == images[index].tobytes()
        assert tactile.contact_points(image).tobytes() == points[index].tobytes()


def test_memory_layout_changes_nothing():
    force, place = random_contacts((6, 15))
    images = tactile.image(force, place)
    points = tactile.contact_points(images)
    wide_force, wide_place = np.zeros((6, 150, 3, 4)), np.zeros((6, 150, 3, 4, 3))
    wide_force[:, 9::10], wide_place[:, 9::10] = force, place
    views = [
        (wide_force[:, 9::10], wide_place[:, 9::10]),
        (np.asfortranarray(force), np.asfortranarray(place)),
        (force[::-1][::-1], place[::-1][::-1]),
    ]
    for view_force, view_place in views:
        again = tactile.image(view_force, view_place)
        assert again.tobytes() == images.tobytes()
        assert tactile.contact_points(again).tobytes() == points.tobytes()
    assert tactile.contact_points(np.asfortranarray(images)).tobytes() == points.tobytes()


def test_inputs_are_left_alone():
    force, place = random_contacts((3,))
    force.setflags(write=False)
    place.setflags(write=False)
    images = tactile.image(force, place)
    images.setflags(write=False)
    tactile.contact_points(images)
