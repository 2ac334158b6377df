"""The hand's set-ups: what a pose changes, which grips hold in it, and what moving the object
costs.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from farm.errors import ConfigError
from farm.sim.engines import BatchEngine
from farm.sim.sim import Sim
from farm.tasks.finger_gait import model
from farm.tasks.finger_gait.hand import FINGERS, GRIPS, JOINTS
from farm.tasks.finger_gait.holding import MOVED, TURNED, moved
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig
from farm.tasks.loop import Batch, again
from farm.tasks.rollouts import Rollouts, whole


def held(config: FingerGaitConfig) -> tuple[FingerGait, Rollouts]:
    """A rollout whose targets stay those of the start grip."""
    task = FingerGait(config)
    sim = Sim(task.engine(lambda mj_model: BatchEngine(mj_model, 1)))

    def hold() -> Rollouts:
        task.setup(sim)
        batch = Batch(task, sim, [None])
        while not batch.over:
            batch.step(np.zeros((1, len(JOINTS))))
        return batch.rollouts()

    return task, again(hold)


def body(text: str, name: str) -> ET.Element:
    return next(each for each in ET.fromstring(text).iter("body") if each.get("name") == name)


def test_the_pose_of_the_reproduction_is_what_the_files_say() -> None:
    files = model.files(["bar"], "opposed")
    assert files["hand.xml"] == (model.folder() / "hand.xml").read_text("utf-8")
    assert files["object.xml"] == (model.folder() / "objects/bar.xml").read_text("utf-8")


def test_a_pose_turns_links_by_the_angles_it_says() -> None:
    opposed, between = (model.files(["bar"], pose)["hand.xml"] for pose in ("opposed", "between"))
    for name, axis, angle in (
        ("index_base", (0, 0, 1), -0.14),
        ("middle_base", (0, 0, 1), 0.14),
        ("thumb_base", (-1, 0, 0), 1.35 - 1.072),
        ("thumb_proximal", (0, 0, 1), 0.22 - 0.284),
    ):
        before, after = (
            np.array([float(word) for word in (body(text, name).get("quat") or "1 0 0 0").split()])
            for text in (opposed, between)
        )
        assert np.linalg.norm(after) == pytest.approx(1.0, abs=1e-6)
        turn = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])
        assert after == pytest.approx(product(before, turn), abs=2e-6), name
    assert ET.fromstring(between).find("option").get("impratio") == "10"  # type: ignore[union-attr]
    assert (
        body(model.files(["bolt"], "between")["object.xml"], "object").get("pos")
        == "0.08 0.0235 0.02"
    )


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of two quaternions wxyz."""
    return np.array(
        [a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))]
    )


@pytest.mark.parametrize("grip", list(GRIPS))
def test_every_grip_holds_the_bar_with_the_thumb_between_the_fingers(grip: str) -> None:
    _, rollouts = held(FingerGaitConfig(pose="between", start_grip=grip, goal_grip=grip, steps=30))
    frames = whole(rollouts, 0)
    shift, turn = moved(frames["qpos"][-1, len(JOINTS) :], frames["qpos"][0, len(JOINTS) :])
    force = frames["force"][-1].sum(axis=-1)
    assert shift < 0.002
    assert np.degrees(turn) < 12.0
    assert ((force >= 1.5) == [finger in GRIPS[grip] for finger in FINGERS]).all()


def test_an_unknown_pose() -> None:
    with pytest.raises(ConfigError, match="unknown pose 'upside-down'; known are opposed, between"):
        FingerGaitConfig(pose="upside-down")


def test_moving_the_object_costs_its_shift_and_turn_squared() -> None:
    config = FingerGaitConfig(pose="between", motion=0.5, steps=10)
    task, rollouts = held(config)
    assert task.spec().terms[-1] == "motion"
    frames = whole(rollouts, 0)
    shift, turn = moved(frames["qpos"][1:, len(JOINTS) :], frames["qpos"][0, len(JOINTS) :])
    expected = -0.5 * np.minimum((shift / MOVED) ** 2 + (turn / TURNED) ** 2, 20.0)
    assert rollouts.terms[0, :, -1] == pytest.approx(expected, rel=0.02)
    assert expected[-1] < -0.01, "it does turn a little"
    _, free = held(replace(config, motion=0.0))
    assert free.terms.shape[-1] == rollouts.terms.shape[-1] - 1
    assert free.terms[0].tobytes() == np.ascontiguousarray(rollouts.terms[0, :, :-1]).tobytes()
