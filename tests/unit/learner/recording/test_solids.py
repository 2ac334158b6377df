"""A model's geometries as Rerun draws them."""

import numpy as np
import pytest

from farm.sim.scene import Geometry
from learner.recording.solids import ENDLESS, grid


@pytest.mark.parametrize(("side", "end"), [(0.0, ENDLESS), (4.0, 4.0)])
def test_the_lines_on_a_floor_end_with_the_floor_that_is_drawn(side: float, end: float) -> None:
    floor = Geometry(
        name="floor",
        body="world",
        shape="plane",
        size=(side, side, 1.0),
        position=(0.0, 0.0, 0.0),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        colour=(1.0, 1.0, 1.0, 1.0),
        grid=2.0,
    )
    strips = grid(floor).strips
    assert strips is not None
    assert np.abs(np.array(strips.as_arrow_array().to_pylist())[..., :2]).max() == end
