"""States to go back to: what a run returns to when hosts are expelled, and how many are kept."""

from dataclasses import replace
from pathlib import Path

import made
import pytest

from farm.errors import CheckpointError
from learner.algorithms import PGPE
from learner.run.checkpoint import Checkpoint
from learner.run.states import MOST, States, goes_back_to


def at(generation: int, **more: object) -> Checkpoint:
    return replace(
        made.checkpoint(state=replace(PGPE().init(3), generation=generation).to_dict()), **more
    )  # type: ignore[arg-type]


def test_it_goes_back_to_the_first_of_all_that_are_expelled(tmp_path: Path) -> None:
    states = States(tmp_path / "states")
    for generation in (0, 3, 8):
        states.keep(at(generation, seconds=1.0 * generation))
    first, expelled = {"a": 0, "liar": 8, "other": 3, "new": 20}, {"liar": "why", "new": "why"}
    now = at(20, first=first, expelled=expelled, seconds=50.0, reissued=7, undone=2)
    assert goes_back_to(now) == 8
    back = states.without(now)
    assert (back.state["generation"], back.undone, back.seconds, back.reissued) == (8, 14, 50.0, 7)
    assert back.expelled == expelled
    assert (
        states.without(replace(now, expelled=expelled | {"other": "why"})).state["generation"] == 3
    )


def test_a_state_without_wrong_numbers_stays(tmp_path: Path) -> None:
    now = at(
        20,
        first={"a": 0, "late": 20},
        expelled={"late": "only in the round under way", "unknown": "no answer"},
    )
    assert States(tmp_path).without(now) is now


def test_a_bounded_number_is_kept_among_them_the_first(tmp_path: Path) -> None:
    states = States(tmp_path / "states")
    for generation in range(3 * MOST):
        states.keep(at(generation))
    generations = sorted(int(each.name) for each in states.path.iterdir())
    assert len(generations) == MOST
    assert (generations[0], generations[-1]) == (0, 3 * MOST - 1)
    assert (
        max(later - earlier for earlier, later in zip(generations, generations[1:], strict=False))
        <= 8
    )
    for first in (0, 5, 3 * MOST - 1):
        back = states.without(at(200, first={"liar": first}, expelled={"liar": "why"}))
        assert back.state["generation"] == max(each for each in generations if each <= first)
    states.forget_after(5)
    assert all(int(each.name) <= 5 for each in states.path.iterdir())


def test_without_any_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint at .*states/0"):
        States(tmp_path / "states").without(at(4, first={"liar": 0}, expelled={"liar": "why"}))
