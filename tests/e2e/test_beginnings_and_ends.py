"""Where a run may start from, and when it may end before its last generation."""

import numpy as np
import pytest
from made import POLE
from processes import SMALL, Farm

from learner.run import checkpoint as checkpoints
from learner.run.folder import RunFolder

pytestmark = pytest.mark.slow


def test_a_run_that_starts_from_another(farm: Farm) -> None:
    flags = ("--policy", "projected", "--features", "40", *SMALL)
    farm.call("run", "--name", "a", "--generations", "3", *flags)
    words = ("--generations", "0", "--init-from", "runs/a", "--init-sigma")
    farm.call("run", "--name", "b", *words, "run", *flags)
    farm.call("run", "--name", "fresh", *words, "fresh", *flags)
    farm.call(
        "run", "--name", "c", "--generations", "1", "--seed", "7", "--init-from", "runs/a", *flags
    )
    names = ("a", "b", "fresh", "c")
    a, b, fresh, c = (
        checkpoints.load(RunFolder(farm.folder / "runs" / name).checkpoint) for name in names
    )
    assert np.array_equal(b.state["mu"], a.state["mu"])
    assert np.array_equal(fresh.state["mu"], a.state["mu"])
    assert np.array_equal(b.state["sigma"], a.state["sigma"])
    assert np.array_equal(fresh.state["sigma"], np.full_like(a.state["sigma"], 0.3))
    assert np.array_equal(b.constants["frequencies"], a.constants["frequencies"])
    assert np.array_equal(c.constants["phases"], a.constants["phases"]), (
        "they belong to the parameters"
    )
    assert (b.state["generation"], b.rollouts, b.state["best"]) == (0, 0, None)
    assert not np.array_equal(c.state["mu"], a.state["mu"])


def test_runs_that_begin_together_have_folders_of_their_own(farm: Farm) -> None:
    processes = [farm.start("run", "--generations", "1", *SMALL) for _ in range(3)]
    outputs = [process.communicate(timeout=100)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * 3, outputs
    assert len(list((farm.folder / "runs").iterdir())) == 3


def test_a_run_that_ends_when_it_is_solved(farm: Farm) -> None:
    farm.call(
        "run", "--name", "a", "--generations", "100", "--stop-when-solved", "3", "--no-record"
    )
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
    output = farm.call(*once, "--generations", "6")
    assert "continuing after generation 2" in output
    farm.call(*once, "--generations", "6")  # over already: evaluated again, nothing else
    assert len(farm.progress("r")) == 6
    assert farm.summary("r")["parameters_sha256"] == farm.summary("whole")["parameters_sha256"]
    output = farm.call(*once, "--generations", "6", "--seed", "1", status=2)
    assert "a resumed run keeps its settings: --seed is 0 in the run and 1 here" in output
    output = farm.call("run", "--resume-existing", *SMALL, status=2)
    assert "--resume-existing needs --name" in output


@pytest.mark.parametrize(
    ("reward", "flags", "why"),
    [
        ("np.zeros(len(sim))", ("--generations", "4"), "no perturbation changes the reward"),
        ("sim.qpos[:, 0]", ("--generations", "4", "--task-ends"), "ended in their first step"),
        (
            "np.where(action[:, 0] < 5.0, action[:, 0], -20.0)",
            ("--generations", "90", "--algorithm", "es", "--learning-rate-mu", "0.2"),
            "the steps are too large",
        ),
        (
            "-action[:, 0] ** 2",
            ("--generations", "60", "--sigma-floor", "0.9"),
            "sigma is down to 0.9",
        ),
        (
            "-action[:, 0] ** 2",
            ("--generations", "120", "--learning-rate-mu", "0"),
            "not improved for 100 generations",
        ),
    ],
)
def test_a_run_that_does_not_learn_says_so(
    farm: Farm, reward: str, flags: tuple[str, ...], why: str
) -> None:
    ends = "--task-ends" in flags
    text = POLE.replace("np.cos(sim.qpos[:, 0])", reward)
    (farm.folder / "pole.py").write_text(
        text + "\n    def ended(self, sim):\n        return np.full(len(sim), True)\n"
        if ends
        else text
    )
    words = [word for word in flags if word != "--task-ends"]
    output = farm.call(
        "run", "--task", "pole.py:Pole", "--policy", "constant", "--name", "r", *words, *SMALL
    )
    assert output.count(why) == 1
    assert (farm.folder / "runs/r/log.txt").read_text().count(why) == 1
    output = farm.call("run", "--resume", "runs/r", "--generations", "130", "--no-record")
    assert why not in output, "once is enough"
