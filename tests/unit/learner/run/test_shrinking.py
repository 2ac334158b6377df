"""Steps that are halved when validation no longer improves: when, by how much, and that a resumed
run and one that is learnt again have the same.
"""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alone import new_run, state, taken_up

from farm.errors import ConfigError
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.shrinking import Shrinking
from learner.tools.replay.rewind import LearntAgain


@pytest.fixture
def config(pole: str) -> RunConfig:
    """A run that soon gets no better, of which every second generation validates."""
    return configure(
        pole,
        generations=12,
        validate=True,
        pairs=80,
        policy="linear",
        optimiser="clipup",
        learning_rate_mu=2.0,
        max_speed=2.0,
        initial_sigma=1.0,
        shrink_after=1,
    )


def test_it_counts_validations_since_the_best_one_or_the_last_halving() -> None:
    now = Shrinking()
    seen = []
    for better in (True, False, False, True, False, False, False, False):
        now = now.after(better=better, patience=3)
        seen.append((now.waited, now.halvings))
    assert seen == [(0, 0), (1, 0), (2, 0), (0, 0), (1, 0), (2, 0), (0, 1), (1, 1)]
    assert now.share == 0.5
    assert Shrinking().after(better=False, patience=0) == Shrinking(), "never"


def test_steps_are_halved_after_validations_that_are_no_better(
    config: RunConfig, tmp_path: Path
) -> None:
    learner, alone = new_run(config, tmp_path / "r")
    before = learner.state.mu
    lengths = []
    halvings = [0]
    scores = []
    for report in learner.learn(alone):  # type: ignore[arg-type]
        lengths.append(np.abs(learner.state.mu - before).max())
        before = learner.state.mu
        halvings.append(learner.at.shrinking.halvings)
        scores.append(report.progress.validation)
    best = -np.inf
    expected = [0]
    for score in scores:
        expected.append(expected[-1] + int(score is not None and score <= best))
        best = max(best, -np.inf if score is None else score)
    assert halvings == expected
    assert halvings[-1] >= 2, "it stops to become better"
    assert all(  # of at most the largest speed
        length <= 2.0 * 0.5**halved + 1e-12
        for length, halved in zip(lengths, halvings[:-1], strict=True)
    )


def test_a_resumed_run_and_one_that_is_learnt_again_take_the_same_steps(
    config: RunConfig, tmp_path: Path
) -> None:
    for name, generations in (("whole", 12), ("half", 7)):
        learner, alone = new_run(replace(config, generations=generations), tmp_path / name)
        list(learner.learn(alone))  # type: ignore[arg-type]
    learner, alone = taken_up(tmp_path / "half", generations=12)
    list(learner.learn(alone))  # type: ignore[arg-type]
    assert state(tmp_path / "half") == state(tmp_path / "whole")
    again = LearntAgain(RunFolder.open(tmp_path / "whole"), learner.problem)
    with closing(learner.problem.runner()) as runner:
        while again.state.generation < 12:
            again.step(lambda mu, jobs, normaliser: runner.run(mu, jobs, "none", normaliser))
    assert again.state.mu.tobytes() == learner.state.mu.tobytes()
    without, alone = new_run(replace(config, shrink_after=0), tmp_path / "plain")
    list(without.learn(alone))  # type: ignore[arg-type]
    assert without.state.mu.tobytes() != learner.state.mu.tobytes()


def test_it_needs_validation(config: RunConfig) -> None:
    with pytest.raises(ConfigError, match="this run validates nothing: give --validate too"):
        replace(config, validate=False)
    with pytest.raises(ConfigError, match="shrink-after is -1; expected 0 or more"):
        replace(config, shrink_after=-1)


@pytest.mark.parametrize("changed", [{"optimiser": "sgd"}, {"algorithm": "snes"}])
def test_it_needs_steps_that_are_lengths(pole: str, changed: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="those of .* are in proportion to sigma"):
        configure(pole, validate=True, policy="linear", shrink_after=3, **changed)
    for algorithm in ("pgpe", "ars", "es"):
        optimiser = {"optimiser": "adam"} if algorithm == "pgpe" else {}
        right = {"validate": True, "policy": "linear", "shrink_after": 3, **optimiser}
        configure(pole, algorithm=algorithm, **right)
