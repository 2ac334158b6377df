"""What an algorithm of one's own returns is checked: a clear line names the method, the value and
what was expected.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from farm.errors import TaskError
from farm.settings import Settings
from learner import algorithms
from learner.algorithms import SearchState

SIZE = 4


@dataclass(frozen=True, kw_only=True)
class Plain(Settings):
    """A valid algorithm that never moves."""

    def signs(self):
        return (1,)

    def init(self, size):
        return SearchState(mu=np.zeros(size), sigma=np.ones(size))

    def restore(self, values):
        return SearchState.from_dict(values)

    def ask(self, state, rng):
        return rng.standard_normal((3, state.mu.size))

    def tell(self, state, eps, returns):
        return replace(state, generation=state.generation + 1)


def with_(**methods):
    return type(
        "Mine", (Plain,), {name: lambda *_, value=value: value for name, value in methods.items()}
    )()


def a_state(size=SIZE, generation=0):
    return SearchState(mu=np.zeros(size), sigma=np.ones(size), generation=generation)


def test_a_valid_one_passes_through():
    state = algorithms.begin(Plain(), SIZE)
    eps = algorithms.ask(Plain(), state, np.random.default_rng(0))
    assert eps.shape == (3, SIZE)
    assert algorithms.tell(Plain(), state, eps, np.zeros((3, 1))).generation == 1


def test_a_start_is_added_to_the_first_mean():
    start = np.arange(4.0)
    assert algorithms.begin(Plain(), SIZE, start).mu.tolist() == start.tolist()
    assert algorithms.begin(Plain(), SIZE).mu.tolist() == [0.0] * SIZE


@pytest.mark.parametrize(
    ("methods", "line"),
    [
        ({"signs": (1, 1)}, r"signs of Mine gave \(1, 1\); expected \(1,\) or \(1, -1\)"),
        ({"signs": None}, "signs of Mine gave None"),
        ({"signs": np.array([1, -1])}, r"signs of Mine gave array\(\[ 1, -1\]\)"),
        ({"init": None}, "init of Mine gave a NoneType; expected a farm.SearchState"),
        (
            {"init": a_state(3)},
            "init of Mine gave a state of 3 parameters in generation 0; expected 4 in generation 0",
        ),
        ({"init": a_state(generation=2)}, "in generation 2; expected 4 in generation 0"),
    ],
)
def test_an_invalid_beginning(methods, line):
    with pytest.raises(TaskError, match=line):
        algorithms.begin(with_(**methods), SIZE)


@pytest.mark.parametrize(
    ("eps", "line"),
    [
        (
            np.zeros((3, 5)),
            r"ask of Mine gave an array of float64 \(3, 5\); expected numbers of shape \(rows, 4\)",
        ),
        (np.zeros((0, SIZE)), r"gave an array of float64 \(0, 4\)"),
        (np.zeros(SIZE), r"gave an array of float64 \(4,\)"),
        (np.zeros((3, SIZE), dtype=int), r"gave an array of int64 \(3, 4\)"),
        ([[0.0] * SIZE], "gave a list"),
        (np.full((3, SIZE), np.nan), "ask of Mine is not finite in generation 0"),
    ],
)
def test_invalid_perturbations(eps, line):
    with pytest.raises(TaskError, match=line):
        algorithms.ask(with_(ask=eps), a_state(), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("after", "line"),
    [
        (None, "tell of Mine gave a NoneType; expected a farm.SearchState"),
        (a_state(), "a state of 4 parameters in generation 0; expected 4 in generation 1"),
        (a_state(5, 1), "a state of 5 parameters in generation 1; expected 4 in generation 1"),
    ],
)
def test_an_invalid_update(after, line):
    with pytest.raises(TaskError, match=line):
        algorithms.tell(with_(tell=after), a_state(), np.zeros((3, SIZE)), np.zeros((3, 1)))
