"""Settings of the finger gait: which make sense, and that the thesis' are the defaults."""

import math

import pytest

from farm.errors import ConfigError
from farm.tasks.finger_gait.task import FingerGait, FingerGaitConfig

UNKNOWN = {
    "start_grip": "index\\+thumb, middle\\+thumb, index\\+middle\\+thumb",
    "goal_grip": "index\\+thumb, middle\\+thumb, index\\+middle\\+thumb",
    "state": "joints, joints\\+contacts, tactile, joints\\+tactile",
    "reward": "basic, full",
    "weights": "direct, projected",
}


@pytest.mark.parametrize("field", UNKNOWN)
def test_an_unknown_name_answers_with_the_known_ones(field):
    with pytest.raises(ConfigError, match=f"unknown .*'nothing'; known are {UNKNOWN[field]}"):
        FingerGaitConfig(**{field: "nothing"})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("steps", value) for value in (-1, 2, 1001)),
        *(("gamma", value) for value in (0.0, -0.5, 1.0000001, math.nan, math.inf)),
        *(("joints_scale", value) for value in (0.0, -1.0, math.inf, math.nan)),
        *(("contacts_scale", value) for value in (0.0, math.inf)),
        *(("tactile_scale", value) for value in (0.0, math.nan)),
    ],
)
def test_a_number_out_of_range_is_named(field, value):
    with pytest.raises(ConfigError, match=f"^{field.replace('_', '-')} is {value}; expected"):
        FingerGaitConfig(**{field: value})


@pytest.mark.parametrize(
    ("field", "value"), [("steps", 3), ("steps", 1000), ("gamma", 1.0), ("gamma", 1e-9)]
)
def test_a_number_at_the_edge_is_taken(field, value):
    assert getattr(FingerGaitConfig(**{field: value}), field) == value


def test_the_defaults_are_those_of_the_thesis():
    config = FingerGaitConfig()
    assert (config.object, config.start_grip, config.goal_grip) == (
        "bar",
        "index+thumb",
        "index+middle+thumb",
    )
    assert (config.state, config.reward, config.weights) == ("joints", "full", "projected")
    assert (FingerGait(config).steps, config.gamma, config.perturb) == (15, 0.95, False)
    assert (config.action, config.clip) == ("offset", True)
    assert config.joints_scale == config.contacts_scale == config.tactile_scale == 1.0
