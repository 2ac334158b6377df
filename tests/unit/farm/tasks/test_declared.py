"""Declarations of a task and what its methods give: scores, channels, cameras; their mistakes."""

from typing import Any

import numpy as np
import pytest
from carts import Pole, new_runner, thetas

from farm.errors import ConfigError, TaskError
from farm.sim.channels import Camera, Channel
from farm.tasks.base import Record, Score, Task
from farm.tasks.probe import specification
from learner.pool.round import Shapes
from learner.tools.chain.chain import check


class Scored(Pole):
    """Has two terms for whole rollouts, and knows success; each needs a whole rollout."""

    def score(self, record: Record) -> Score:
        at = np.arange(self.steps) < record.steps[:, None]
        terms = np.stack([at * 1.0, -0.5 * at], axis=2)
        return Score(terms=terms, success=record.steps == self.steps)


def changed(**members: Any) -> type[Task]:
    """A small task with other members."""
    return type("Changed", (Pole,), members)


def test_whole_scores_have_as_many_terms_as_they_give_and_know_success() -> None:
    runner = new_runner(Scored)
    assert runner.spec.terms == ("reward_1", "reward_2")
    assert runner.spec.success
    rollouts = runner.rollouts(thetas(runner, 3, 4.0), [None, (1, 2, 3, 4), (5, 0, 0, 0)])
    np.testing.assert_array_equal(rollouts.success, rollouts.steps == runner.task.steps)
    assert rollouts.terms.shape[2] == 2
    shapes = Shapes(
        trace=runner.spec.trace_shape,
        frame=runner.spec.shapes(len(runner.scene.bodies)),
        observation=runner.spec.observation,
        measures=0,
        substeps=runner.task.substeps,
    )
    assert runner.trajectory(rollouts, 0).fits(shapes.frame), "a learner takes it"


@pytest.mark.parametrize(
    ("terms", "success", "line"),
    [
        (np.zeros((1, 7)), None, r"terms of score gave an array of shape \(1, 7\)"),
        (np.zeros((2, 3, 1)), None, r"terms of score gave an array of shape \(2, 3, 1\)"),
        ("x", None, "terms of score gave a str"),
        (None, np.zeros(3), r"success of score gave an array of shape \(3,\)"),
        (None, [True], "success of score gave a list"),
    ],
)
def test_a_score_of_another_shape_is_named(terms: Any, success: Any, line: str) -> None:
    def score(self: Task, record: Record) -> Score:
        whole = np.zeros((1, self.steps, 1))
        return Score(terms=whole if terms is None else terms, success=success)

    runner = new_runner(changed(score=score))
    with pytest.raises(TaskError, match=line):
        runner.rollouts(thetas(runner, 1), [None])


def test_a_score_whose_terms_change_is_named() -> None:
    def score(self: Task, record: Record) -> Score:
        return Score(terms=np.zeros((1, self.steps, 1 + int(record.steps[0] > 1))))

    runner = new_runner(changed(score=score))
    with pytest.raises(TaskError, match="score gave 2 terms; expected 1"):
        runner.rollouts(thetas(runner, 1), [None])


ANGLE = Channel(name="angle", kind="scalars", shape=(1,))


def measured(self: Task, sim: Any) -> dict[str, Any]:
    return {"angle": sim.qpos[:, 1:]}


def test_what_is_shown_beside_the_channels_is_left_out() -> None:
    def show(self: Task, frames: dict[str, Any]) -> dict[str, Any]:
        return {**frames, "more": frames["angle"]}

    runner = new_runner(changed(channels=(ANGLE,), measure=measured, show=show))
    rollouts = runner.rollouts(thetas(runner, 1), [None])
    assert list(runner.trajectory(rollouts, 0).channels) == ["angle"]


@pytest.mark.parametrize("name", ["qpos", "mocap", "robust/push"])
def test_a_measured_value_has_a_name_of_its_own(name: str) -> None:
    with pytest.raises(TaskError, match=f"measure gave '{name}', which is the simulation's"):
        new_runner(changed(measure=lambda self, sim: {name: sim.qpos}))


@pytest.mark.parametrize(
    ("members", "line"),
    [
        ({"channels": (ANGLE, ANGLE)}, "two channels are named alike: angle, angle"),
        ({"ended": None}, "ended is None; expected a method, or leave it out"),
        ({"success": property(lambda self: True)}, "success is <property .*; expected a method"),
        ({"show": lambda self: {}}, r"show\(self\); expected \(self, frames\)"),
        (
            {"channels": (ANGLE,), "measure": measured, "show": lambda self, frames: []},
            "show gave a list; expected arrays by name",
        ),
    ],
)
def test_a_declaration_that_cannot_be_is_one_line(members: dict[str, Any], line: str) -> None:
    with pytest.raises((ConfigError, TaskError), match=line):
        specification(changed(**members)(Pole.Config()))


@pytest.mark.parametrize(
    "values",
    [
        {"lookat": (0.0, 0.0), "distance": 1.0},
        {"lookat": (0.0, 0.0, "x"), "distance": 1.0},
        {"lookat": 3, "distance": 1.0},
        {"lookat": (0.0, 0.0, 0.0), "distance": 0.0},
        {"lookat": (0.0, 0.0, 0.0), "distance": np.nan},
        {"lookat": (0.0, 0.0, 0.0), "distance": 1.0, "azimuth": None},
    ],
)
def test_a_camera_that_sees_nothing_is_one_line(values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"^camera: .*expected"):
        Camera(**values)


@pytest.mark.parametrize("name", ["top", "length", "longest"])
def test_a_scale_of_a_channel_is_positive(name: str) -> None:
    scale: dict[str, Any] = {name: 0}
    with pytest.raises(ConfigError, match=f"channel angle: {name} is 0; expected a positive"):
        Channel(name="angle", kind="scalars", shape=(1,), **scale)
    Channel(name="angle", kind="scalars", shape=(1,), **{name: 2})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("members", "line"),
    [
        ({"ends": ("up",)}, r"ends is \('up',\); expected where it begins and ends"),
        ({"ends": "up"}, "ends is 'up'; expected where"),
        ({"ends": ("up", "up")}, r"has `ends`, but no reached\(self, sim\), as chains need"),
        (
            {"ends": ("up", "up"), "reached": lambda self, sim: sim.qpos[:, 0] > 0.0},
            r"has `ends`, but no lost\(self, sim\), as chains need",
        ),
    ],
)
def test_a_chain_of_a_task_without_ends_is_one_line(members: dict[str, Any], line: str) -> None:
    class Learnt:
        class problem:  # noqa: N801  a stand-in
            task = changed(**members)(Pole.Config())

    with pytest.raises(ConfigError, match=line):
        check([Learnt])  # type: ignore[list-item]
