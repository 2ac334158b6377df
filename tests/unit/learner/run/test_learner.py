"""A run without a network: what a generation does, what is kept of it, and when a run ends."""

import errno
import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, learnt, new_run, state, taken_up

from farm import seeds
from farm.errors import ConfigError, RunError
from farm.net.telemetry import Report
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import REPLAY_EVERY

pytestmark = pytest.mark.usefixtures("grips_found_once")


@pytest.mark.parametrize("traces", ["extremes", "all", "none"])
def test_a_generation_and_what_is_kept_of_it(pole: str, tmp_path: Path, traces: str) -> None:
    learner, alone = new_run(configure(pole, traces=traces), tmp_path / "r")
    reports = list(learner.learn(alone))  # type: ignore[arg-type]
    assert [report.progress.generation for report in reports] == [1, 2, 3]
    assert learner.folder.progress() == [report.progress for report in reports]
    for report, (generation, jobs, kind) in zip(reports, alone.rounds, strict=True):
        assert kind == traces
        assert report.progress.generation == generation + 1
        assert report.progress.rollouts == 8 * (generation + 1)
        assert jobs.rollouts.tolist()[:5] == [2, 2, 2, 2, 1]
        assert report.sample is not None
        assert report.sample.value == report.progress.mean_policy_return
        shapes = {name: values.shape for name, values in report.traces.items()}
        assert (
            shapes
            == {
                "none": {},
                "extremes": {"best": (4, 1), "worst": (4, 1)},
                "all": {"best": (4, 1), "worst": (4, 1), "all": (8, 4, 1)},
            }[traces]
        )
        if traces == "all":
            returns = -np.abs(report.traces["all"][:, :, 0]).sum(axis=1)
            assert (
                report.traces["best"].tobytes() == report.traces["all"][returns.argmax()].tobytes()
            )
            assert report.progress.return_max == pytest.approx(returns.max(), rel=1e-5)
    evaluation = learner.evaluate(alone)  # type: ignore[arg-type]
    assert evaluation.mean.trajectory is not None
    assert evaluation.replay is not None
    assert evaluation.replay.value == learner.state.best, "the best rollout of all, once more"
    summary = learner.summary("finished", 1, evaluation)
    assert (summary["generations"], summary["rollouts"], summary["mean_policy_success"]) == (
        3,
        24,
        True,
    )
    assert json.dumps(summary)


def test_the_best_is_shown_again_now_and_then(pole: str, tmp_path: Path) -> None:
    learner, alone = new_run(configure(pole, generations=2 * REPLAY_EVERY + 1), tmp_path / "r")
    replays = [r.progress.generation - 1 for r in learner.learn(alone) if r.replay is not None]  # type: ignore[arg-type]
    assert replays, "once in a while"
    assert all(generation % REPLAY_EVERY == 0 for generation in replays)
    rounds = [generation for generation, jobs, _ in alone.rounds if jobs.physics.any()]
    assert rounds == replays


def test_pairs_share_a_start_unless_there_is_but_one(pole: str, tmp_path: Path) -> None:
    for perturb in (True, False):
        learner, alone = new_run(
            configure(pole, perturb=perturb, generations=1), tmp_path / str(perturb)
        )
        list(learner.learn(alone))  # type: ignore[arg-type]
        seeds = alone.rounds[0][1].seeds()
        assert seeds[0:8:2] == seeds[1:8:2]
        assert len(set(seeds[:8])) == (4 if perturb else 1)
        assert seeds[8] is None


def test_pairs_take_shared_starts_in_turn(pole: str, tmp_path: Path) -> None:
    learner, alone = new_run(configure(pole, shared_starts=2, generations=2), tmp_path / "r")
    list(learner.learn(alone))  # type: ignore[arg-type]
    first, second = (jobs.seeds()[:8] for _, jobs, _ in alone.rounds[:2])
    assert first == [first[0], first[0], first[2], first[2]] * 2
    assert first[0] != first[2]
    assert not {*first} & {*second}, "each generation has its own"


@pytest.mark.parametrize(
    "settings", [{}, {"algorithm": "cma-es", "policy": "linear", "population": 5}], ids=str
)
def test_the_mean_return_of_several_episodes_counts(
    settings: dict[str, Any], pole: str, tmp_path: Path
) -> None:
    config = configure(pole, episodes=3, **settings)
    learner, alone = new_run(config, tmp_path / "r")
    before, algorithm = learner.state, config.algorithm_config
    reports = list(learner.learn(alone))  # type: ignore[arg-type]
    jobs, signs = alone.rounds[0][1], len(algorithm.signs())
    rows = len(jobs.eps) // 3
    starts = [seeds.training(0, 0, episode) for episode in range(3)]
    assert jobs.seeds()[: 3 * rows * signs] == [
        seed for seed in starts for _ in range(rows * signs)
    ]
    theta = jobs.theta(before.mu)[: 3 * rows * signs]
    each = alone.returns(theta, jobs.seeds()[: len(theta)]).reshape(3, rows, signs)
    means = (each[0] + each[1] + each[2]) / 3
    after = algorithm.tell(before, algorithm.ask(before, seeds.exploration(0, 0)), means)
    learner, alone = new_run(replace(config, generations=1), tmp_path / "one")
    (first,) = learner.learn(alone)  # type: ignore[arg-type]
    assert learner.state.mu.tobytes() == after.mu.tobytes()
    assert first.progress == replace(reports[0].progress, seconds=first.progress.seconds)
    assert (first.progress.rollouts, first.progress.best) == (each.size, means.max())
    assert (first.progress.return_max, first.progress.return_mean) == (each.max(), each.mean())
    row, column = np.unravel_index(means.argmax(), means.shape)
    evaluation = learner.evaluate(alone)  # type: ignore[arg-type]
    assert evaluation.replay is not None
    assert evaluation.replay.value == each[:, row, column].max(), "the best episode of the best"
    summary = learner.summary("finished", 1, evaluation)
    assert (summary["rollouts"], summary["steps"]) == (each.size, 4 * each.size)


def test_a_run_of_several_episodes_is_resumed(pole: str, tmp_path: Path) -> None:
    config = configure(pole, episodes=2, generations=5)
    learnt(config, tmp_path / "whole")
    learnt(replace(config, generations=2), tmp_path / "half")
    learner, alone = taken_up(tmp_path / "half", generations=5)
    list(learner.learn(alone))  # type: ignore[arg-type]
    assert state(tmp_path / "half") == state(tmp_path / "whole")


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"episodes": 0}, "episodes is 0; expected 1 to 1000"),
        (
            {"episodes": 2, "perturb": False},
            "--episodes 2 and --no-perturb exclude each other: unperturbed rollouts",
        ),
        ({"shared_starts": 0}, "shared-starts is 0; expected 1 or more"),
        ({"shared_starts": 2, "episodes": 2}, "with --episodes all pairs share theirs"),
        ({"shared_starts": 2, "perturb": False}, "--no-perturb exclude each other"),
    ],
)
def test_episodes_that_cannot_be(changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        configure(**changed)


def test_solved_often_enough_is_the_end(pole: str, tmp_path: Path) -> None:
    assert len(learnt(configure(pole, generations=9, stop_when_solved=2), tmp_path / "r")) == 2
    plain = tmp_path / "plain.py"
    plain.write_text(POLE.replace("def success", "def judged"))
    config = configure(f"{plain}:Pole", stop_when_solved=2)
    with pytest.raises(
        ConfigError, match=r"--stop-when-solved: .*:Pole knows returns, but no success"
    ):
        setup.problem(config)


def test_no_better_policy_for_long_enough_is_the_end(pole: str, tmp_path: Path) -> None:
    # With 4 pairs, each 40th generation is validated; steps that are too large spoil the policy.
    config = configure(
        pole,
        generations=400,
        stop_when_stale=50,
        validate=True,
        learning_rate_mu=3.0,
        max_speed=3.0,
    )
    reports = learnt(config, tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    assert at.validated is not None
    assert len(reports) == at.validated.generation + 50 < 400
    half = replace(config, generations=len(reports) - 10)
    learnt(half, tmp_path / "half")
    learner, alone = taken_up(tmp_path / "half", generations=400)
    assert not learner.early
    assert len(list(learner.learn(alone))) == 10  # type: ignore[arg-type]
    assert learner.over
    assert learner.early == (
        "no validated policy has been better for 50 generations (--stop-when-stale)"
    )


def test_stale_policies_are_known_only_by_validation(pole: str) -> None:
    with pytest.raises(ConfigError, match=r"^--stop-when-stale .* give --validate too$"):
        configure(pole, stop_when_stale=5, validate=False)


def test_so_many_steps_are_the_end(pole: str, tmp_path: Path) -> None:
    config = configure(pole, generations=9, stop_after_steps=2 * 8 * 4 + 1)
    assert len(learnt(config, tmp_path / "r")) == 3
    assert checkpoints.load(tmp_path / "r" / "checkpoint").steps == 3 * 8 * 4
    learnt(replace(config, generations=2), tmp_path / "half")
    learner, alone = taken_up(tmp_path / "half", generations=9)
    assert len(list(learner.learn(alone))) == 1  # type: ignore[arg-type]
    assert learner.over
    assert learner.summary("finished", 1, None)["steps"] == 3 * 8 * 4


def test_a_generation_has_the_pairs_that_make_so_many_steps(pole: str, tmp_path: Path) -> None:
    falling = tmp_path / "falling.py"
    falling.write_text(POLE + "\n    def ended(self, sim):\n        return sim.qpos[:, 0] > 0.1\n")
    config = configure(f"{falling}:Pole", generations=6, interactions=30)
    learnt(config, tmp_path / "r")
    progress = [
        json.loads(line) for line in (tmp_path / "r" / "progress.jsonl").read_text().splitlines()
    ]
    pairs = [
        (b["rollouts"] - a["rollouts"]) // 2
        for a, b in itertools.pairwise([{"rollouts": 0}, *progress])
    ]
    assert pairs[0] == 4
    assert all(4 <= each <= 32 for each in pairs)
    assert len(set(pairs)) > 2, "it follows the rollouts' lengths"
    learnt(replace(config, generations=3), tmp_path / "half")
    learner, alone = taken_up(tmp_path / "half", generations=6)
    list(learner.learn(alone))  # type: ignore[arg-type]
    assert state(tmp_path / "half") == state(tmp_path / "r")


def test_how_many_pairs_follow() -> None:
    config = configure(pairs=10, interactions=1000)
    # 10 pairs made 500 steps: 20 would make 1000. At least 10, at most 80.
    assert [config.pairs_after(0, steps) for steps in (500, 501, 5000, 1)] == [20, 20, 10, 80]
    assert config.pairs_after(20, 500) == 40
    assert configure(pairs=10).pairs_after(0, 500) == 0


def test_an_offset_of_the_reward_is_for_learning_alone(pole: str, tmp_path: Path) -> None:
    falling = tmp_path / "falling.py"
    falling.write_text(POLE + "\n    def ended(self, sim):\n        return sim.qpos[:, 0] > 0.1\n")
    config = configure(f"{falling}:Pole", gamma=0.5, generations=1)
    plain = new_run(config, tmp_path / "plain")
    shifted = new_run(
        replace(config, task_config=replace(config.task_config, reward_offset=3.0)),
        tmp_path / "shifted",
    )
    (first,), (second,) = (list(learner.learn(alone)) for learner, alone in (plain, shifted))  # type: ignore[arg-type]
    assert second.progress.return_mean == first.progress.return_mean
    assert second.progress.mean_policy_return == first.progress.mean_policy_return
    learner, alone = shifted
    steps, returns = alone.collect().steps[:8], alone.collect().returns[:8]
    assert len(set(steps.tolist())) > 1
    values = returns + 3.0 * (1.0 - 0.5**steps) / 0.5
    assert learner.state.best == pytest.approx(values.max())
    assert state(tmp_path / "plain") != state(tmp_path / "shifted")


def test_a_run_in_which_all_rollouts_fail_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fast.py").write_text(
        POLE.replace(
            "        sim.qpos[row, 0] =", "        sim.qvel[row] = 1e30\n        sim.qpos[row, 0] ="
        )
    )
    learner, alone = new_run(replace(configure("fast.py:Pole"), generations=9), tmp_path / "r")
    before = learner.state
    reports = []
    with pytest.raises(RunError, match="all rollouts of 3 generations failed, .* farm check"):
        reports.extend(learner.learn(alone))  # type: ignore[arg-type]
    assert learner.state.generation == 3
    assert learner.state.mu.tolist() == before.mu.tolist()
    assert (learner.state.best, learner.state.baseline) == (None, None)
    lines = RunFolder(tmp_path / "r").progress()
    assert [line.failed for line in lines] == [8, 8, 8]
    assert {
        (line.return_mean, line.return_std, line.best, line.mean_policy_return) for line in lines
    } == {(None, None, None, None)}
    assert "1e+12" not in (tmp_path / "r" / "progress.jsonl").read_text().lower()
    assert "1000000000000" not in (tmp_path / "r" / "progress.jsonl").read_text()


def test_a_full_disk_leaves_the_last_generation(
    pole: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, alone = new_run(configure(pole), tmp_path / "r")
    reports: Iterator[Report] = learner.learn(alone)  # type: ignore[arg-type]
    next(reports)
    before = state(tmp_path / "r")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, "save", full)
    with pytest.raises(
        RunError,
        match=r"No space left on device; the run is saved up to generation 1: make room and",
    ):
        next(reports)
    monkeypatch.undo()
    assert learner.state.generation == 1
    assert state(tmp_path / "r") == before
    learner, alone = taken_up(tmp_path / "r")
    list(learner.learn(alone))  # type: ignore[arg-type]
    learnt(configure(pole), tmp_path / "whole")
    assert state(tmp_path / "r") == state(tmp_path / "whole")
    assert [p.generation for p in learner.folder.progress()] == [1, 2, 3]
