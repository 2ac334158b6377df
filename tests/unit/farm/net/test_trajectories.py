"""Trajectories that are sent: in single precision, whatever their numbers, and only for the task
that they are of.
"""

import dataclasses

import numpy as np
import pytest
from messages import SHAPES, WIRE, trajectory

from farm.net import codec
from farm.sim.trajectory import Trajectory


def test_a_trajectory_comes_back_to_single_precision():
    source = trajectory()
    back = codec.decode(codec.encode(source), Trajectory)
    assert (back.value, back.success, back.times.tolist()) == (
        source.value,
        source.success,
        source.times.tolist(),
    )
    assert list(back.arrays()) == list(source.arrays())
    for name, values in back.arrays().items():
        assert values.dtype == np.float32
        np.testing.assert_array_equal(source.arrays()[name], values)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, 1e300, -1e300, np.nan])
def test_a_trajectory_of_overflowing_numbers_can_be_sent(bad):
    values = np.zeros((4, 2))
    values[2, 1] = bad
    payload = codec.encode(trajectory(terms=values, channels={"force": values}))
    back = codec.decode(payload, Trajectory)
    for array in (back.terms, back.channels["force"]):
        assert array[2, 1] == np.float32(1e30 if bad > 0 else -1e30)
        assert not array[:2].any()


@pytest.mark.parametrize(
    ("name", "width"),
    [
        ("bodies", (3, 6)),
        ("bodies", (2, 7)),
        ("actions", (1,)),
        ("terms", (4,)),
        ("channels/force", (2,)),
        ("channels/images", (2, 12)),
        ("channels/more", (1,)),
    ],
)
def test_a_trajectory_fits_its_runs_task_or_not(name, width):
    assert WIRE.fits(SHAPES)
    assert not WIRE.fits(
        {name: shape for name, shape in SHAPES.items() if name != "channels/force"}
    )
    values, (kind, _, channel) = np.zeros((4, *width), "<f4"), name.partition("/")
    change = {"channels": WIRE.channels | {channel: values}} if channel else {kind: values}
    other = codec.decode(codec.encode(dataclasses.replace(WIRE, **change)), Trajectory)
    assert other.fits(SHAPES | {name: width})
    assert not other.fits(SHAPES)
