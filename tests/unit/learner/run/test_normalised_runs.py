"""Runs whose observations are normalised, without a network."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import Alone, learnt, new_run, state, taken_up

from farm.errors import CheckpointError, ConfigError
from farm.moments import normaliser_of
from farm.net.work import Jobs
from farm.policies.normalised import Normalised
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import REPLAY_EVERY, Learner
from learner.tools.replay.loaded import load

pytestmark = pytest.mark.usefixtures("grips_found_once")


NORMALISED: dict[str, Any] = {"policy": "linear", "normalise": True, "initial_sigma": 0.5}


def observed(
    problem: setup.Problem, rounds: list[tuple[int, Jobs, str]], mus: list[np.ndarray]
) -> np.ndarray:
    """What the exploring rollouts of a run saw, one by one, each generation normalised by those
    before it.
    """
    parts, history = [], [np.zeros((0, 2))]
    runner = problem.runner()
    for (_, jobs, _), mu in zip(rounds, mus, strict=True):
        before = np.concatenate(history)
        mean, deviation = (
            (before.mean(axis=0), before.std(axis=0)) if len(before) else (np.zeros(2), np.ones(2))
        )
        runner.policy = Normalised(problem.policy, np.stack([mean, deviation]))
        for theta, seed in zip(jobs.theta(mu)[:8], jobs.seeds(), strict=False):
            rollouts = runner.rollouts(theta[None], [seed])
            qpos = np.concatenate([rollouts.start["qpos"], rollouts.frames["qpos"][0, :-1]])
            # Euler's, from rest
            velocity = np.diff(np.concatenate([qpos[:1], qpos]), axis=0) / 0.02
            parts.append(np.concatenate([qpos, velocity], axis=1))
        history = list(parts)
    return np.concatenate(parts)


def test_observations_are_normalised_by_all_generations_before(pole: str, tmp_path: Path) -> None:
    learner, alone = new_run(configure(pole, **NORMALISED), tmp_path / "r")
    mus = []
    for _ in learner.learn(alone):  # type: ignore[arg-type]
        mus.append(np.array(RunFolder.open(tmp_path / "r").parameters.rows()["mu"][-1]))
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    x = observed(learner.problem, alone.rounds, [np.full(3, 1.0), *mus[:-1]])
    assert at.moments[0] == len(x) == 3 * 8 * 4, "exploring rollouts alone count"
    np.testing.assert_allclose(at.moments[1:3], x.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(at.moments[3:], x.var(axis=0) * len(x), rtol=1e-6)
    expected = [normaliser_of(np.zeros(5)), *learner.folder.parameters.rows()["normaliser"]]
    for (_, jobs, _), normalisers, row in zip(
        alone.rounds, alone.normalisers, expected, strict=False
    ):
        assert normalisers[0].tobytes() == row.tobytes()
        assert jobs.rollouts.sum() >= 9
    assert expected[-1].tobytes() == normaliser_of(at.moments).tobytes()


def test_a_normalised_run_is_the_same_in_any_order_and_after_a_resume(
    pole: str, tmp_path: Path
) -> None:
    def after(path: Path) -> tuple[bytes, ...]:
        at = checkpoints.load(path / "checkpoint")
        assert at.best is not None
        return (*state(path), at.moments.tobytes(), at.best.normaliser.tobytes())

    learnt(configure(pole, **NORMALISED, generations=6), tmp_path / "whole")
    problem, at = setup.start(configure(pole, **NORMALISED, generations=6), "other")
    folder = RunFolder.create(tmp_path / "other", problem.config)
    list(Learner(problem, folder, at).learn(Alone(problem, seed=5)))  # type: ignore[arg-type]
    learnt(configure(pole, **NORMALISED, generations=3), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=6)
    list(learner.learn(alone))  # type: ignore[arg-type]
    assert after(tmp_path / "whole") == after(tmp_path / "other") == after(tmp_path / "r")
    plain = learnt(
        configure(pole, **{**NORMALISED, "normalise": False}, generations=6), tmp_path / "plain"
    )
    assert plain[-1].progress.return_mean != learner.folder.progress()[-1].return_mean


def test_every_policy_of_a_normalised_run_is_seen_as_it_was(pole: str, tmp_path: Path) -> None:
    reports = learnt(configure(pole, **NORMALISED, generations=REPLAY_EVERY + 2), tmp_path / "r")
    for generation in (0, 1, 5, REPLAY_EVERY + 1):
        earlier = load(tmp_path / "r", generation)
        assert earlier.rollout().trajectory.value == reports[generation].progress.mean_policy_return
    replays = [report for report in reports if report.replay is not None]
    assert replays
    # The best rollout so far, in a round whose observations are normalised otherwise
    for report in replays:
        assert report.replay is not None
        assert report.replay.value == reports[report.progress.generation - 2].progress.best


def test_a_run_that_starts_from_a_normalised_one_goes_on_with_its_statistics(
    pole: str, tmp_path: Path
) -> None:
    learnt(configure(pole, **NORMALISED), tmp_path / "first")
    other = checkpoints.load(tmp_path / "first" / "checkpoint")
    _, at = setup.start(configure(pole, **NORMALISED, init_from=str(tmp_path / "first")), "second")
    assert at.moments.tobytes() == other.moments.tobytes()
    plain = configure(pole, **{**NORMALISED, "normalise": False}, init_from=str(tmp_path / "first"))
    with pytest.raises(ConfigError, match="its parameters mean something else"):
        setup.start(plain, "second")


def test_statistics_of_other_observations_are_refused(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, **NORMALISED, generations=1), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, moments=np.zeros(3)))
    with pytest.raises(
        CheckpointError, match="its statistics are of other observations than its task's"
    ):
        taken_up(tmp_path / "r", generations=2)
