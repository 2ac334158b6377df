"""Where a run may start from, and when it may end before its last generation."""

import numpy as np
import pytest
from processes import SMALL, Farm

from learner import checkpoint as checkpoints
from learner.run_folder import RunFolder

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("sigma", ["run", "fresh"])
def test_a_run_that_starts_from_another(farm: Farm, sigma: str) -> None:
    flags = ("--policy", "projected", "--features", "40", *SMALL)
    farm.call("run", "--name", "a", "--generations", "3", *flags)
    farm.call("run", "--name", "b", "--generations", "0", "--init-from", "runs/a", "--init-sigma", sigma, *flags)
    farm.call("run", "--name", "c", "--generations", "1", "--seed", "7", "--init-from", "runs/a", *flags)
    a, b, c = (checkpoints.load(RunFolder(farm.folder / "runs" / name).checkpoint) for name in "abc")
    assert np.array_equal(b.state["mu"], a.state["mu"])
    expected = a.state["sigma"] if sigma == "run" else np.full_like(a.state["sigma"], 0.3)
    assert np.array_equal(b.state["sigma"], expected)
    assert np.array_equal(b.constants["frequencies"], a.constants["frequencies"])
    assert np.array_equal(c.constants["phases"], a.constants["phases"]), "they belong to the parameters"
    assert (b.state["generation"], b.rollouts, b.state["best"]) == (0, 0, None)
    assert not np.array_equal(c.state["mu"], a.state["mu"])


def test_runs_that_begin_together_have_folders_of_their_own(farm: Farm) -> None:
    processes = [farm.start("run", "--generations", "1", *SMALL) for _ in range(3)]
    said = [process.communicate(timeout=100)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * 3, said
    assert len(list((farm.folder / "runs").iterdir())) == 3


def test_a_run_that_ends_when_it_is_solved(farm: Farm) -> None:
    farm.call("run", "--name", "a", "--generations", "100", "--stop-when-solved", "3", "--no-record")
    summary, lines = farm.summary("a"), farm.progress("a")
    assert summary["state"] == "finished"
    assert summary["generations"] == len(lines) < 100
    solved = [line["mean_policy_success"] for line in lines]
    assert solved[-3:] == [True] * 3
    assert not any(all(solved[i : i + 3]) for i in range(len(solved) - 3))


def test_a_run_that_is_begun_once_and_gone_on_with_later(farm: Farm) -> None:
    farm.call("run", "--name", "whole", "--generations", "6", *SMALL)
    once = ("run", "--name", "r", "--resume-existing", *SMALL)
    farm.call(*once, "--generations", "2")
    said = farm.call(*once, "--generations", "6")
    assert "continuing after generation 2" in said
    farm.call(*once, "--generations", "6")  # over already: evaluated again, nothing else
    assert len(farm.progress("r")) == 6
    assert farm.summary("r")["parameters_sha256"] == farm.summary("whole")["parameters_sha256"]
    said = farm.call(*once, "--generations", "6", "--seed", "1", status=2)
    assert "a resumed run keeps its settings: --seed is 0 in the run and 1 here" in said
    said = farm.call("run", "--resume-existing", *SMALL, status=2)
    assert "--resume-existing needs --name" in said
