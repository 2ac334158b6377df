"""Validation: the mean policies that it scores, which of them is the run's, and what it is compared
with.
"""

import errno
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, new_run, state, taken_up
from made import pole as plain_pole

import farm
from farm import seeds
from farm.errors import ConfigError, RunError
from farm.net.work import Jobs
from farm.policies.base import PolicyConfig
from farm.policies.networks import Constant
from farm.runner import Runner
from learner.commands import learning
from learner.commands.of_run import OfRun
from learner.run import checkpoint as checkpoints
from learner.run.config import VALIDATION_ROLLOUTS, RunConfig, configure, from_dict, to_dict
from learner.run.evaluation import score
from learner.run.folder import RunFolder
from learner.run.hash_chain import state_of
from learner.run.worth import without_learning
from learner.tools.verify.stored import stored
from learner.tools.verify.verify import verify_some, workers

SETTINGS: dict[str, Any] = {
    "validate": True,
    "pairs": 80,
    "policy": "linear",
    "normalise": True,
    "initial_sigma": 1.0,
}
"""With 160 exploring rollouts every second generation validates."""


def whole(config: RunConfig, path: Path) -> dict[str, Any]:
    """The summary of a run to its end."""
    learner, alone = new_run(config, path)
    list(learner.learn(alone))  # type: ignore[arg-type]
    return learner.summary("finished", 1, learner.evaluate(alone))  # type: ignore[arg-type]


@pytest.fixture
def config(pole: str) -> RunConfig:
    return configure(pole, generations=6, learning_rate_mu=2.0, **SETTINGS)


def test_tasks_without_presets_are_validated(pole: str, tmp_path: Path) -> None:
    general = f"{plain_pole(tmp_path / 'plain')}:Pole"
    assert configure(general).validate
    assert RunConfig(task=general).validate
    assert configure("gym:Swimmer-v5").validate
    assert not configure(general, validate=False).validate
    assert not configure(pole).validate
    assert not configure("finger-gait").validate
    old = {name: value for name, value in to_dict(configure(general)).items() if name != "validate"}
    assert not from_dict(old, "an earlier release's").validate


@pytest.mark.parametrize("rollouts", [1, 7, 16, 30, 319, 320, 321, 5000])
def test_it_is_as_frequent_as_five_percent_allow(config: RunConfig, rollouts: int) -> None:
    assert config.validates(0, rollouts)
    every = next(generation for generation in count(1) if config.validates(generation, rollouts))
    assert 20 * VALIDATION_ROLLOUTS <= every * rollouts
    assert every == 1 or 20 * VALIDATION_ROLLOUTS > (every - 1) * rollouts
    assert config.validates(3 * every, rollouts)
    assert not replace(config, validate=False).validates(0, rollouts)


def test_it_changes_nothing_that_is_learnt(config: RunConfig, tmp_path: Path) -> None:
    validated, plain = (
        whole(each, tmp_path / str(each.validate))
        for each in (config, replace(config, validate=False))
    )
    assert state(tmp_path / "True") == state(tmp_path / "False")
    assert validated["rollouts"] == plain["rollouts"] == 6 * 160
    at = [checkpoints.load(tmp_path / name / "checkpoint") for name in ("True", "False")]
    assert at[0].moments.tobytes() == at[1].moments.tobytes()
    assert at[1].validated is None
    assert "policy_generation" not in plain
    assert '"validation"' not in (tmp_path / "False" / "progress.jsonl").read_text()


def test_the_scores_are_those_of_the_mean_policies_from_its_starts(
    config: RunConfig, tmp_path: Path
) -> None:
    learner, alone = new_run(config, tmp_path / "r")
    reports, means = [], [learner.state.mu]
    for report in learner.learn(alone):  # type: ignore[arg-type]
        reports.append(report)
        means.append(learner.state.mu)
    starts = [seeds.validation(config.seed, start) for start in range(VALIDATION_ROLLOUTS)]
    for report, mu, (_, jobs, _), normaliser in zip(
        reports, means, alone.rounds, alone.normalisers, strict=False
    ):
        if report.generation % 2 == 0:
            assert report.progress.validation is None
            continue
        assert jobs.seeds()[-VALIDATION_ROLLOUTS:] == starts
        again = alone.problem.runner().run(mu, Jobs.mean("none", starts), "none", normaliser)
        assert report.progress.validation == score(again.returns)


def test_the_best_is_the_policy_of_the_run(config: RunConfig, tmp_path: Path) -> None:
    path = tmp_path / "r"
    summary = whole(config, path)
    scores = {line.generation - 1: line.validation for line in RunFolder.open(path).progress()}
    known = {generation: value for generation, value in scores.items() if value is not None}
    best = max(known, key=lambda each: known[each])
    assert 0 < best < 6, "with steps this large it becomes better and worse"
    assert summary["policy_generation"] == best
    assert summary["best_validation"] == known[best]
    assert summary["last_validation"] < known[best]
    policy = farm.load(path)
    assert (policy.generation, farm.load(path, last=True).generation) == (best, 6)
    assert policy.rollout().trajectory.value == summary["mean_policy_return"]
    assert (
        farm.load(path, last=True).mu.tobytes() == farm.load(path, 6).mu.tobytes() == state(path)[0]
    )
    kept = RunFolder.open(path).parameters.mean(best)
    validated = checkpoints.load(path / "checkpoint").validated
    assert validated is not None
    assert (validated.mu.tobytes(), validated.normaliser.tobytes()) == tuple(
        each.tobytes() for each in kept
    )


def test_a_better_last_policy_is_the_run_s(config: RunConfig, tmp_path: Path) -> None:
    learner, _ = new_run(config, tmp_path / "r")
    best = checkpoints.Validated(score=1.0, generation=2, mu=np.zeros(1))
    scored = {
        last: replace(learner.at, validated=best, last_score=last).better
        for last in (None, 0.5, 1.0, 1.5)
    }
    assert scored == {None: best, 0.5: best, 1.0: best, 1.5: None}, "of equal ones the earlier"
    first = replace(learner.at, validated=replace(best, generation=0))
    assert first.better is None, "the policy before learning is none of a run that goes on"
    assert replace(first, last_score=0.5).better == first.validated
    assert replace(learner.at, validated=None, last_score=0.0).better is None


def test_of_equal_ones_the_first(tmp_path: Path) -> None:
    path = tmp_path / "flat.py"
    path.write_text(POLE.replace("return -np.abs(sim.qpos[:, 0])", "return np.zeros(len(sim))"))
    assert whole(configure(f"{path}:Pole", **SETTINGS), tmp_path / "r")["policy_generation"] == 0


def test_a_resumed_or_extended_run_has_the_same_policy(config: RunConfig, tmp_path: Path) -> None:
    summary = whole(config, tmp_path / "whole")
    whole(replace(config, generations=3), tmp_path / "half")
    learner, alone = taken_up(tmp_path / "half", generations=6)
    for _ in learner.learn(alone):  # type: ignore[arg-type]
        assert learner.at.last_score is None
    again = learner.summary("finished", 1, learner.evaluate(alone))  # type: ignore[arg-type]
    for name in (
        "chain",
        "policy_generation",
        "best_validation",
        "last_validation",
        "robust_return",
        "without_learning",
    ):
        assert again[name] == summary[name]


def test_a_finished_run_that_is_taken_up_keeps_its_results_until_it_goes_on(
    config: RunConfig, tmp_path: Path
) -> None:
    summary = whole(config, tmp_path / "r")
    folder = RunFolder.open(tmp_path / "r")
    folder.write_summary(summary)
    taken_up(tmp_path / "r", generations=9)  # and ended, as by a logger that cannot begin
    assert folder.read_summary() == summary
    assert farm.load(tmp_path / "r").generation == summary["policy_generation"]
    learner, alone = taken_up(tmp_path / "r", generations=9)
    next(iter(learner.learn(alone)))  # type: ignore[arg-type]
    assert folder.read_summary() is None


def test_a_full_disk_at_the_end_is_one_line(
    config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, alone = new_run(config, tmp_path / "r")
    list(learner.learn(alone))  # type: ignore[arg-type]

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(RunFolder, "save", full)
    with pytest.raises(RunError, match="saved up to generation 6: make room and --resume it"):
        learner.evaluate(alone)  # type: ignore[arg-type]


def test_a_changed_average_is_another_policy(config: RunConfig, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "r")
    summary = whole(config, tmp_path / "r")
    folder.write_summary(summary)
    learner, _ = taken_up(tmp_path / "r", average=3)
    assert (learner.at.last_score, folder.read_summary()) == (None, None)


def test_a_share_of_it_is_verified(config: RunConfig, tmp_path: Path) -> None:
    whole(config, tmp_path / "r")
    run = stored(RunFolder.open(tmp_path / "r"))
    with workers(run, None, lambda: False) as simulate:
        assert [rollouts for _, rollouts in verify_some(run, [1, 2, 3], simulate)] == [
            160,
            160,
            160,
        ]


def test_the_last_policy_s_score_is_not_in_the_chain(config: RunConfig, tmp_path: Path) -> None:
    learner, _ = new_run(config, tmp_path / "r")
    assert state_of(learner.at) == state_of(replace(learner.at, last_score=1.0))
    best = checkpoints.Validated(score=1.0, generation=0, mu=np.zeros(1))
    assert state_of(learner.at) != state_of(replace(learner.at, validated=best))


def test_the_average_is_the_last_policy(config: RunConfig, tmp_path: Path) -> None:
    summary = whole(replace(config, average=3), tmp_path / "r")
    average, last = farm.load(tmp_path / "r", last=True), farm.load(tmp_path / "r", 6)
    assert average.mu.tobytes() != last.mu.tobytes()
    starts = [seeds.validation(config.seed, start) for start in range(VALIDATION_ROLLOUTS)]
    assert summary["last_validation"] == score(
        average.runner.run(average.mu, Jobs.mean("none", starts)).returns
    )


def test_doing_nothing_and_the_best_constant_action(config: RunConfig, tmp_path: Path) -> None:
    learner, alone = new_run(config, tmp_path / "r")
    figures = without_learning(learner.problem, lambda: False)
    assert figures is not None
    runner = Runner(alone.problem.task, Constant(PolicyConfig(), alone.problem.spec, {}))
    starts = [seeds.evaluation_start(0, start) for start in range(100)]
    for name, action in (("nothing", [0.0]), ("constant", figures["constant"]["action"])):
        assert figures[name]["score"] == score(
            runner.run(np.array(action), Jobs.mean("none", starts)).returns
        )
        assert figures[name]["success_rate"] == 1.0
    assert without_learning(learner.problem, lambda: False) == figures
    assert without_learning(learner.problem, lambda: True) is None


def test_a_machine_that_cannot_simulate_it_says_so(
    config: RunConfig, tmp_path: Path, monkeypatch, caplog
) -> None:
    learner, _ = new_run(config, tmp_path / "r")
    monkeypatch.setattr(type(learner.problem.task), "reset", lambda *_: 1 / 0)
    monkeypatch.setattr(
        learner.problem.task, "config", replace(learner.problem.task.config, strict=True)
    )
    assert without_learning(learner.problem, lambda: False) is None
    assert "this machine cannot simulate doing nothing" in caplog.text


SUMMARY: dict[str, Any] = {
    "generations": 9,
    "policy_generation": 9,
    "best_validation": 2.5,
    "last_validation": 2.75,
    "robust_score": 270.4,
    "robust_success_rate": None,
    "without_learning": {"nothing": {"score": 53.0}, "constant": {"score": 61.2, "action": [0.5]}},
}


def test_the_end_says_what_the_policy_is_worth() -> None:
    assert learning.compared(SUMMARY) == [
        "the policy returns 270.4 from 100 starts; doing nothing 53, the best of 32 constant"
        " actions 61.2"
    ]
    assert learning.compared({**SUMMARY, "without_learning": None}) == []
    measured = {"score": 53.0, "success_rate": 0.25, "measures": {"speed": 0.5}}
    others = {"nothing": measured, "constant": {**measured, "measures": {"speed": None}}}
    worse = {
        **SUMMARY,
        "robust_score": 53.0,
        "robust_success_rate": 0.5,
        "robust_measures": {"speed": 1.0},
    }
    line, warning = learning.compared({**worse, "without_learning": others})
    assert (
        line
        == "the policy returns 53 (success 50%, speed 1) from 100 starts; doing nothing 53 (success"
        " 25%, speed 0.5), the best of 32 constant actions 53 (success 25%, speed -)"
    )
    assert warning.startswith("warning: the policy is not better than doing nothing")
    assert len(learning.compared({**SUMMARY, "robust_score": None})) == 2


def test_the_end_says_no_number_twice() -> None:
    summary = {
        **SUMMARY,
        "mean_policy_return": 271.0,
        "mean_policy_success": None,
        "robust_return": 270.4,
        "robust_failed": 0,
    }
    alone: dict[str, Any] = {"without_learning": None}
    first = "the mean policy returns 271.000 from the undisturbed start"
    assert learning.worth(summary) == first
    assert learning.worth({**summary, **alone}) == f"{first}; from others 270.400 on average"
    summary |= {"mean_policy_success": True, "robust_success_rate": 0.98, "robust_failed": 2}
    failed = "2 of 100 failed, unstable or by an error"
    first = "the mean policy returns 271.000 and succeeds from the undisturbed start"
    assert learning.worth(summary) == f"{first}; {failed}"
    assert learning.worth({**summary, **alone}) == f"{first}; robust success 98%; {failed}"
    summary |= {"mean_policy_success": False, "mean_policy_return": None, "robust_failed": 0}
    assert learning.worth(summary) == (
        "the mean policy fails and does not succeed from the undisturbed start"
    )


def test_the_end_says_which_policy_it_is() -> None:
    assert learning.chosen(SUMMARY) == []
    assert learning.chosen({**SUMMARY, "policy_generation": 4}) == [
        "the run's policy is the mean after generation 4: in validation it returned 2.500, the last"
        " one 2.750; --last takes that one"
    ]


def test_the_last_policy_or_one_of_a_generation() -> None:
    class Shown(OfRun):
        generation = 3

    with pytest.raises(ConfigError, match="--last and --generation exclude each other"):
        Shown(last=True)
