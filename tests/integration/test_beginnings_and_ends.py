"""Where a run may begin, and when it may end before its last generation."""

import numpy as np
import pytest
from processes import SMALL, Farm

from learner import checkpoint as checkpoints
from learner.folder import RunFolder


@pytest.mark.parametrize("sigma", ["run", "fresh"])
def test_a_run_that_starts_from_another(farm: Farm, sigma: str) -> None:
    flags = ("--controller", "projected", "--features", "40", *SMALL)
    farm.call("run", "--name", "a", "--generations", "3", *flags)
    farm.call("run", "--name", "b", "--generations", "0", "--init-from", "runs/a", "--init-sigma", sigma, *flags)
    farm.call("run", "--name", "c", "--generations", "1", "--seed", "7", "--init-from", "runs/a", *flags)
    a, b, c = (checkpoints.load(RunFolder(farm.folder / "runs" / name).checkpoint) for name in "abc")
    assert np.array_equal(b.state["mu"], a.state["mu"])
    expected = a.state["sigma"] if sigma == "run" else np.full_like(a.state["sigma"], 0.8)
    assert np.array_equal(b.state["sigma"], expected)
    assert np.array_equal(b.frequencies, a.frequencies)
    assert np.array_equal(c.phases, a.phases), "parameters mean nothing without their features"
    assert (b.state["generation"], b.rollouts, b.state["best"]) == (0, 0, None)
    assert not np.array_equal(c.state["mu"], a.state["mu"])


def test_a_run_that_ends_when_it_is_solved(farm: Farm) -> None:
    farm.call("run", "--name", "a", "--generations", "100", "--stop-when-solved", "3", "--no-record")
    summary, lines = farm.summary("a"), farm.progress("a")
    assert summary["state"] == "finished"
    assert summary["generations"] == len(lines) < 100
    solved = [line["mean_policy_success"] for line in lines]
    assert solved[-3:] == [True] * 3
    assert not any(all(solved[i : i + 3]) for i in range(len(solved) - 3))
