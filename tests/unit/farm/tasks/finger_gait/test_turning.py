"""The plate is turned by the script of benchmarks/turning.py."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from benchmarks.turning import Keys, Script, script_of, task, turn
from farm.tasks.finger_gait.hand import FINGERS
from farm.tasks.finger_gait.task import TIMESTEP


@pytest.fixture(scope="module")
def gait():
    return task()


@pytest.fixture(scope="module")
def targets(gait):
    """One cycle's."""
    return script_of(Keys(gait.hand, Script()), 1)


@pytest.fixture(scope="module")
def turned(gait, targets):
    """A cycle of it, from the nominal start and from a perturbed one."""
    return turn(gait, targets, [None, (4, 0, 0, 0)])


def test_a_cycle_turns_the_plate_and_holds_it(turned):
    assert not turned.lost.any()
    assert (turned.degrees[:, -1] > 20.0).all()
    assert turned.tilt.max() < 15.0
    assert turned.drift.max() < 0.01


def test_fingers_are_lifted_in_turn_and_the_thumb_never(turned):
    away = ~turned.felt[0].all(axis=0)
    assert away[FINGERS.index("index")]
    assert away[FINGERS.index("middle")]
    assert not away[FINGERS.index("thumb")]
    assert (turned.felt.sum(axis=-1) >= 2).all()


def test_a_plate_is_lost_where_it_is_out_of_place(turned):
    assert turned.first(0).qpos.shape == (1, *turned.qpos.shape[1:])
    dropped = replace(turned, lost=turned.lost | (np.arange(turned.lost.shape[1]) >= 50))
    assert dropped.first(1).degrees.shape == (1, 50)


def test_nothing_but_fingertips_touches_the_plate(gait, turned):
    hand = gait.hand
    data = mujoco.MjData(hand.model)
    touched = set()
    for data.qpos[:] in turned.qpos[0]:
        mujoco.mj_forward(hand.model, data)
        touched |= set(data.contact.geom.flat)
    assert touched == {*hand.tip_geoms, hand.model.geom("plate").id}


def test_it_turns_as_far_with_a_finer_step_of_the_physics(gait, targets, turned):
    finer = copy.copy(gait.model)
    finer.opt.timestep = TIMESTEP / 5
    data = mujoco.MjData(finer)
    data.qpos[:], data.eq_active[:] = turned.qpos[0, 0], 0
    for data.ctrl[:] in targets:
        mujoco.mj_step(finer, data, 5)
    w, x, y, z = data.qpos[-4:]
    degrees = -np.degrees(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
    assert degrees == pytest.approx(turned.degrees[0, -1], abs=3.0)
