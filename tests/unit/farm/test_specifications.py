"""Specifications: a worker serves those of the same code, files by permission only, and names the
reason otherwise.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made import POLE, pole, spec_of

from farm import plugins
from farm.errors import UnservedError
from farm.net import codec
from farm.net.messages import Spec
from farm.net.work import Jobs
from farm.policies.fourier import Direct, FeaturesConfig
from farm.runner import Runner, served
from farm.tasks.probe import specification


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return pole(tmp_path)


@pytest.fixture
def spec(file: Path) -> Spec:
    """What a learner says of a task in that file."""
    task_spec = specification(plugins.find("tasks", f"{file}:Pole").target())
    constants = Direct.draw(FeaturesConfig(features=4), task_spec, np.random.default_rng(0))
    message = spec_of(
        file, "direct", task_config={"steps": 2}, policy_config={"features": 4}, constants=constants
    )
    return codec.decode(codec.encode(message), Spec)


def test_it_is_built_as_it_is_specified(spec, file):
    task, policy = served(spec, (file,))
    assert spec.task == "pole.py:Pole", "a file is named without its folder"
    assert (task.steps, policy.size) == (2, 4)
    heavier = task.sources["model.xml"].replace('mass="1"', 'mass="5"')
    other, _ = served(replace(spec, files={"model.xml": heavier}), (file,))
    assert (task.model.body_mass[1], other.model.body_mass[1]) == (
        1.0,
        5.0,
    ), "the run's texts count"
    outcomes = [
        Runner(*served(spec, (file,))).run(np.ones(4), Jobs.mean("none", [None])) for _ in range(2)
    ]
    assert outcomes[0].returns.tobytes() == outcomes[1].returns.tobytes()


def test_a_file_is_served_by_permission_only_and_only_if_it_is_the_same(spec, file, tmp_path):
    with pytest.raises(
        UnservedError,
        match=r"pole\.py is a file on the learner's machine: .* --allow-file pole\.py",
    ):
        served(spec)
    other = pole(tmp_path, name="other.py")
    with pytest.raises(UnservedError, match="--allow-file pole.py"):
        served(spec, (other,))
    changed = pole(tmp_path / "changed", POLE + "\nraise RuntimeError('it was imported')\n")
    with pytest.raises(
        UnservedError, match=r"pole\.py differs from the learner's pole\.py: copy the learner's"
    ):
        served(spec, (changed,))
    with pytest.raises(UnservedError, match="has no class 'Hole'; it has Pole"):
        served(replace(spec, task="pole.py:Hole"), (file,))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("task", "pole.py differs from the learner's"),
        (
            "policy",
            (
                "its code of 'direct' differs from the learner's: install the learner's release on"
                " both sides"
            ),
        ),
        ("simulation", r"its simulation's code differs from the learner's \(farm/\)"),
    ],
)
@pytest.mark.parametrize("digest", ["0" * 64, None])
def test_other_code_is_refused_and_named(spec, file, name, words, digest):
    code = {key: value for key, value in spec.code.items() if key != name}
    with pytest.raises(UnservedError, match=words):
        served(replace(spec, code=code if digest is None else code | {name: digest}), (file,))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"task": "juggling"},
            (
                r"unknown task 'juggling'; known are finger-gait, fragile-bar, turning, gym, or"
                r" FILE\.py:CLASS"
            ),
        ),
        ({"policy": "pid"}, "unknown policy 'pid'; known are direct"),
        (
            {"policy_release": "mine 2"},
            "the run uses direct of mine 2, but here direct belongs to rolloutfarm",
        ),
        (
            {"task": "finger-gait", "release": "theirs 1"},
            "the run uses finger-gait of theirs 1, but here finger-gait belongs to rolloutfarm",
        ),
        (
            {"task_release": "gymnasium 9"},
            "the run uses pole.py:Pole of gymnasium 9, but .* is installed here",
        ),
        (
            {"task_config": {"colour": "red"}},
            "pole.py:Pole: unknown setting colour; known are steps",
        ),
        ({"task_config": {"steps": "15"}}, "steps is '15'; expected int"),
        ({"task_config": {"steps": np.array([15, 15])}}, "steps is .*; expected int"),
        ({"task_config": {"gamma": None}}, "gamma is None; expected float"),
        ({"policy_config": {"bandwidth": np.ones(2)}}, "bandwidth is .*; expected float"),
        ({"policy_config": {"depth": 3}}, "direct: unknown setting depth"),
        ({"policy_config": {b"features": 50}}, "direct: unknown setting b'features'"),
        ({"constants": {}}, "constant 'frequencies' of the policy is missing"),
        (
            {"constants": {b"frequencies": np.zeros((4, 2)), "phases": np.zeros(4)}},
            "'frequencies' .* is missing",
        ),
        ({"files": {}}, "has no model"),
        ({"files": {"model.xml": "<mujoco>"}}, "MuJoCo refuses the model"),
    ],
    ids=str,
)
def test_a_specification_that_makes_no_sense_is_a_clear_error(spec, file, change, words):
    with pytest.raises(UnservedError, match=words) as caught:
        served(replace(spec, **change), (file,))
    assert len(str(caught.value).splitlines()) == 1


def test_a_file_that_changes_meanwhile_is_what_it_is_now(spec, file):
    """A worker goes on from run to run; the file that it may serve is edited on both sides."""
    served(spec, (file,))
    file.write_text(POLE.replace("steps = 4", "steps = 7"))
    with pytest.raises(UnservedError, match="differs from the learner's"):
        served(spec, (file,))
    code = spec.code | {"task": plugins.find("tasks", f"{file}:Pole").digest()}
    task, _ = served(replace(spec, code=code, task_config={}), (file,))
    assert task.steps == 7


def test_what_is_no_task_is_no_task(spec, tmp_path):
    """A file that may be served still gives no class of another kind."""
    path = pole(tmp_path, "class Pole:\n    pass\n")
    code = spec.code | {"task": plugins.find("tasks", f"{path}:Pole").digest()}
    with pytest.raises(UnservedError, match="pole.py:Pole is not a Task"):
        served(replace(spec, code=code), (path,))
