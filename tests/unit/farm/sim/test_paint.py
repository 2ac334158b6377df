"""Colours of what a model leaves unpainted, and the grid on a floor."""

import numpy as np
import pytest

from farm.sim import paint
from farm.sim.model_files import compiled
from farm.sim.scene import Scene

MJCF = """
<mujoco>
  <asset><material name="grey" rgba="0.5 0.5 0.5 1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="4 0 1"/>
    <geom name="rail" type="box" size="1 0.1 0.1"/>
    <geom name="mat" type="plane" size="1 1 1" rgba="0.2 0.2 0.2 1"/>
    <body name="torso">
      <freejoint/>
      <geom name="chest" size="0.1"/>
      <geom name="painted" size="0.1" rgba="1 0 0 1"/>
      <geom name="of a material" size="0.1" material="grey"/>
      <body name="head"><geom name="head" size="0.1" pos="0 0 0.2"/></body>
      <body name="arm"><joint/><geom name="arm" size="0.1" pos="0.2 0 0"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return compiled(MJCF, "made up")


@pytest.fixture(scope="module")
def colour(model):
    rgba = paint.colours(model)
    return lambda name: tuple(rgba[model.geom(name).id].tolist())


def test_a_body_without_a_colour_has_one_with_what_is_fixed_to_it(colour):
    first, second = (tuple(part / 255 for part in rgb) for rgb in paint.PALETTE[:2])
    assert colour("chest")[:3] == colour("head")[:3] == pytest.approx(first)
    assert colour("arm")[:3] == pytest.approx(second)


def test_colours_of_the_model_stay(model, colour):
    assert colour("painted") == (1.0, 0.0, 0.0, 1.0)
    assert colour("of a material") == pytest.approx((0.5, 0.5, 0.5, 1.0))
    assert colour("mat") == pytest.approx((0.2, 0.2, 0.2, 1.0))
    assert colour("rail") == (0.5, 0.5, 0.5, 1.0), "what never moves is no body of its own"


def test_an_unpainted_floor_is_light_and_has_a_grid(model, colour):
    assert colour("floor") == paint.FLOOR
    assert paint.floors(model) == [model.geom("floor").id]
    grids = {each.name: each.grid for each in Scene(model).geometries()}
    assert grids["floor"] == Scene(model).grid > 0.0
    assert set(grids.values()) == {0.0, grids["floor"]}


def test_drawing_leaves_the_model_alone(model):
    before = bytes(model.geom_rgba), bytes(model.geom_matid)
    Scene(model).geometries()
    paint.colours(model)
    assert (bytes(model.geom_rgba), bytes(model.geom_matid)) == before


@pytest.mark.parametrize(
    ("radius", "step"), [(1.0, 1.0), (0.45, 0.5), (0.17, 0.1), (0.8, 0.5), (30.0, 20.0)]
)
def test_lines_are_about_a_radius_apart(radius, step):
    assert paint.spacing(radius) == pytest.approx(step)


def test_lines_end_where_a_floor_ends():
    lines = paint.grid(np.array([1.0, 0.25]), 0.5)
    assert lines.shape == (5 + 1, 2, 2), "across at -1, -0.5, 0, 0.5, 1; along at 0"
    assert sorted(set(lines[:5, 0, 0].tolist())) == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert np.abs(lines[..., 0]).max() == 1.0
    assert np.abs(lines[..., 1]).max() == 0.25
    endless = paint.grid(np.zeros(2), 0.5)
    assert len(endless) == 2 * 121
    assert np.abs(endless).max() == 30.0


def test_beside_a_floor_there_are_no_lines():
    floor = np.array([1.0, 0.25])
    assert len(paint.grid(floor, 0.5, np.array([0.9, 0.0]), 1)) == 2 + 1, "at 0.5, 1; along at 0"
    assert not len(paint.grid(floor, 0.5, np.array([9.0, 0.0]), 8))


@pytest.mark.parametrize("deficiency", ["protan", "deutan"])
def test_neighbours_in_the_palette_differ_for_the_colour_blind(deficiency):
    """By the simulation of F. Vienot, H. Brettel and J. D. Mollon, 1999, in linear RGB."""
    to_lms = np.array(
        [[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]]
    )
    seen = {
        "protan": np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]]),
        "deutan": np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]]),
    }[deficiency]
    linear = (np.array(paint.PALETTE) / 255) ** 2.2
    shown = np.clip(linear @ (np.linalg.inv(to_lms) @ seen @ to_lms).T, 0.0, 1.0) ** (1 / 2.2)
    apart = np.linalg.norm(shown - np.roll(shown, 1, axis=0), axis=1)
    assert apart.min() > 0.2
    assert len(paint.PALETTE) == 7
