"""PGPE's state and configuration: frozen, checked, the same after a checkpoint."""

import dataclasses
import math
import re

import numpy as np
import pytest
from pgpe_cases import CHOICES, cases, name_of, sample

from farm.errors import ConfigError
from learner.algorithms import PGPE, PGPEState


@pytest.mark.parametrize("choices", cases(), ids=name_of)
def test_the_state_passed_in_is_never_changed(choices):
    config = PGPE(**choices)
    state, eps, returns = sample(0, config)
    before = {
        k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in state.to_dict().items()
    }
    eps.setflags(write=False)
    returns.setflags(write=False)
    config.tell(state, eps, returns)
    now = {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in state.to_dict().items()}
    assert now == before


def test_arrays_are_own_and_read_only():
    source = np.ones(2)
    state = PGPEState(mu=source, sigma=source)
    source[0] = 9.0
    assert state.mu[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        state.mu[0] = 3.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.generation = 3


@pytest.mark.parametrize("optimiser", CHOICES["optimiser"])
def test_a_round_trip_through_a_dict_keeps_every_bit(optimiser):
    config = PGPE(optimiser=optimiser)
    state, eps, returns = sample(5, config)
    state = config.tell(state, eps, returns)
    again = config.restore({k: v for k, v in reversed(state.to_dict().items())})
    one, two = config.tell(state, eps, returns), config.tell(again, eps, returns)
    for name, value in one.to_dict().items():
        other = two.to_dict()[name]
        if isinstance(value, np.ndarray):
            assert value.tobytes() == other.tobytes()
        else:
            assert value == other


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mu", np.zeros((2, 2))),
        ("mu", [0.0, 0.0]),
        ("mu", np.zeros(0)),
        ("mu", np.zeros(2, dtype=np.float32)),
        ("mu", np.array([0.0, math.nan])),
        ("sigma", np.ones(3)),
        ("sigma", np.array([1.0, 0.0])),
        ("velocity", np.ones(1)),
        ("first_moment", None),
        ("second_moment", np.ones(5)),
        ("baseline", "high"),
        ("baseline", math.nan),
        ("best", math.inf),
        ("best", True),
        ("generation", -1),
        ("generation", 1.0),
        ("generation", None),
    ],
)
def test_a_wrong_value_in_a_checkpoint_is_named(key, value):
    values = {**PGPE().init(2).to_dict(), key: value}
    with pytest.raises(ValueError, match=key):
        PGPEState.from_dict(values)


def test_missing_and_unknown_keys_are_named():
    values = PGPE().init(2).to_dict()
    with pytest.raises(ValueError, match="unknown speed"):
        PGPEState.from_dict({**values, "speed": 1.0})
    del values["best"]
    with pytest.raises(ValueError, match="missing best"):
        PGPEState.from_dict(values)


def test_a_state_of_another_optimiser_is_refused():
    state = PGPE(optimiser="adam").init(2)
    with pytest.raises(ValueError, match="velocity has 0 entries, expected 2 with clipup"):
        PGPE(optimiser="clipup").restore(state.to_dict())
    with pytest.raises(ValueError, match="first_moment has 2 entries"):
        PGPE().tell(state, np.zeros((15, 2)), np.zeros((15, 2)))


NUMBERS = [field.name for field in dataclasses.fields(PGPE) if isinstance(field.default, float)]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "1", None, True])
def test_a_number_must_be_finite(name, value):
    with pytest.raises(ConfigError, match=f"{name.replace('_', '-')} is "):
        PGPE(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, -0.1) for name in NUMBERS if name != "initial_mu"),
        ("pairs", 0),
        ("pairs", 1.5),
        ("pairs", True),
        ("momentum", 1.0),
        ("second_moment_decay", 1.0),
        ("max_speed", 0.0),
        ("sigma_floor", 0.0),
        ("sigma_cap", 1.1),
        ("initial_sigma", 1e-4),
        *((name, "best") for name in CHOICES),
    ],
)
def test_a_wrong_value_is_named(name, value):
    with pytest.raises(
        ConfigError, match=re.escape(repr(value) if isinstance(value, str) else str(value))
    ) as error:
        PGPE(**{name: value})
    assert name.replace("_", "-") in str(error.value)


@pytest.mark.parametrize("size", [0, -1])
def test_a_size_without_parameters_is_refused(size):
    with pytest.raises(ValueError, match="mu must have one parameter or more|negative"):
        PGPE().init(size)


def test_defaults_are_the_papers_rule():
    config = PGPE()
    state = config.init(3)
    assert (config.pairs, config.learning_rate_mu, config.learning_rate_sigma) == (15, 0.1, 0.2)
    assert (state.mu.tolist(), state.sigma.tolist()) == ([1.0] * 3, [2.0] * 3)
    assert (state.best, state.baseline, state.generation) == (None, None, 0)
