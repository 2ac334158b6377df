"""A run without a network: start, progress, resume, and loading its results."""

import errno
import itertools
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from alone import POLE, Alone

import farm
from farm import plugins, seeds
from farm.errors import CheckpointError, ConfigError, RunError
from farm.moments import normaliser
from farm.net.telemetry import Report
from farm.net.work import Jobs
from farm.policies.normalised import Normalised
from farm.rollouts import served
from learner.again.replay import load
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.learner import REPLAY_EVERY, Learner

pytestmark = pytest.mark.usefixtures("grips_found_once")


@pytest.fixture
def pole(tmp_path: Path) -> str:
    path = tmp_path / "pole.py"
    path.write_text(POLE)
    return f"{path}:Pole"


def begun(config: RunConfig, path: Path) -> tuple[Learner, Alone]:
    found, at = setup.start(config, path.name)
    return Learner(found, RunFolder.create(path, config), at), Alone(found)


def learnt(config: RunConfig, path: Path) -> list[Report]:
    learner, alone = begun(config, path)
    return list(learner.learn(alone))  # type: ignore[arg-type]


def taken_up(path: Path, *, mixed: bool = False, **changed: Any) -> tuple[Learner, Alone]:
    folder = RunFolder.open(path)
    config = replace(folder.read_config(), **changed)
    found, at = setup.resumed(folder, config, mixed=mixed)
    folder.rewind(at)
    folder.write_config(config)
    return Learner(found, folder, at), Alone(found, 1)


def state(path: Path) -> tuple[bytes, bytes]:
    at = checkpoints.load(path / "checkpoint")
    return at.state["mu"].tobytes(), at.state["sigma"].tobytes()


# ---------------------------------------------------------------- learning


@pytest.mark.parametrize("traces", ["extremes", "all", "none"])
def test_a_generation_and_what_is_kept_of_it(pole: str, tmp_path: Path, traces: str) -> None:
    learner, alone = begun(configure(pole, traces=traces), tmp_path / "r")
    reports = list(learner.learn(alone))  # type: ignore[arg-type]
    assert [report.progress.generation for report in reports] == [1, 2, 3]
    assert learner.folder.progress() == [report.progress for report in reports]
    for report, (generation, jobs, wanted) in zip(reports, alone.rounds, strict=True):
        assert wanted == traces
        assert report.progress.generation == generation + 1
        assert report.progress.rollouts == 8 * (generation + 1)
        assert jobs.rollouts.tolist()[:5] == [2, 2, 2, 2, 1]
        assert report.sample is not None
        assert report.sample.value == report.progress.mean_policy_return
        shapes = {name: values.shape for name, values in report.traces.items()}
        assert shapes == {
            "none": {}, "extremes": {"best": (4, 1), "worst": (4, 1)},
            "all": {"best": (4, 1), "worst": (4, 1), "all": (8, 4, 1)},
        }[traces]  # fmt: skip
        if traces == "all":
            returns = -np.abs(report.traces["all"][:, :, 0]).sum(axis=1)
            assert report.traces["best"].tobytes() == report.traces["all"][returns.argmax()].tobytes()
            assert report.progress.return_max == pytest.approx(returns.max(), rel=1e-5)
    evaluation = learner.evaluate(alone)  # type: ignore[arg-type]
    assert evaluation.mean.trajectory is not None
    assert evaluation.replay is not None
    assert evaluation.replay.value == learner.state.best, "the best rollout of all, once more"
    summary = learner.summary("finished", 1, evaluation)
    assert (summary["generations"], summary["rollouts"], summary["mean_policy_success"]) == (3, 24, True)
    assert json.dumps(summary)


def test_the_best_is_shown_again_now_and_then(pole: str, tmp_path: Path) -> None:
    learner, alone = begun(configure(pole, generations=2 * REPLAY_EVERY + 1), tmp_path / "r")
    shown = [r.progress.generation - 1 for r in learner.learn(alone) if r.replay is not None]  # type: ignore[arg-type]
    assert shown, "once in a while"
    assert all(generation % REPLAY_EVERY == 0 for generation in shown)
    seen = [generation for generation, jobs, _ in alone.rounds if jobs.physics.any()]
    assert seen == shown


def test_pairs_share_a_start_unless_there_is_but_one(pole: str, tmp_path: Path) -> None:
    for perturb in (True, False):
        learner, alone = begun(configure(pole, perturb=perturb, generations=1), tmp_path / str(perturb))
        list(learner.learn(alone))  # type: ignore[arg-type]
        seeds = alone.rounds[0][1].seeds()
        assert seeds[0:8:2] == seeds[1:8:2]
        assert len(set(seeds[:8])) == (4 if perturb else 1)
        assert seeds[8] is None


@pytest.mark.parametrize("settings", [{}, {"algorithm": "cma-es", "policy": "linear", "population": 5}], ids=str)
def test_the_mean_return_of_several_episodes_counts(settings: dict[str, Any], pole: str, tmp_path: Path) -> None:
    config = configure(pole, episodes=3, **settings)
    learner, alone = begun(config, tmp_path / "r")
    before, algorithm = learner.state, config.algorithm_config
    reports = list(learner.learn(alone))  # type: ignore[arg-type]
    jobs, signs = alone.rounds[0][1], len(algorithm.signs())
    rows = len(jobs.eps) // 3
    drawn = [seeds.training(0, 0, episode) for episode in range(3)]
    assert jobs.seeds()[: 3 * rows * signs] == [seed for seed in drawn for _ in range(rows * signs)]
    theta = jobs.theta(before.mu)[: 3 * rows * signs]
    each = alone.returns(theta, jobs.seeds()[: len(theta)]).reshape(3, rows, signs)
    told = (each[0] + each[1] + each[2]) / 3
    after = algorithm.tell(before, algorithm.ask(before, seeds.exploration(0, 0)), told)
    learner, alone = begun(replace(config, generations=1), tmp_path / "one")
    (first,) = learner.learn(alone)  # type: ignore[arg-type]
    assert learner.state.mu.tobytes() == after.mu.tobytes()
    assert first.progress == replace(reports[0].progress, seconds=first.progress.seconds)
    assert (first.progress.rollouts, first.progress.best) == (each.size, told.max())
    assert (first.progress.return_max, first.progress.return_mean) == (each.max(), each.mean())
    row, column = np.unravel_index(told.argmax(), told.shape)
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
    ("changed", "said"),
    [
        ({"episodes": 0}, "episodes is 0; expected 1 to 1000"),
        ({"episodes": 2, "perturb": False}, "--episodes 2 and --no-perturb exclude each other: unperturbed rollouts"),
    ],
)
def test_episodes_that_cannot_be(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        configure(**changed)


def test_solved_often_enough_is_the_end(pole: str, tmp_path: Path) -> None:
    assert len(learnt(configure(pole, generations=9, stop_when_solved=2), tmp_path / "r")) == 2
    plain = tmp_path / "plain.py"
    plain.write_text(POLE.replace("def success", "def judged"))
    config = configure(f"{plain}:Pole", stop_when_solved=2)
    with pytest.raises(ConfigError, match=r"--stop-when-solved: .*:Pole knows returns, but no success"):
        setup.problem(config)


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
    progress = [json.loads(line) for line in (tmp_path / "r" / "progress.jsonl").read_text().splitlines()]
    pairs = [(b["rollouts"] - a["rollouts"]) // 2 for a, b in itertools.pairwise([{"rollouts": 0}, *progress])]
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
    plain, shifted = (
        begun(config, tmp_path / "plain"),
        begun(replace(config, task_config=replace(config.task_config, reward_offset=3.0)), tmp_path / "shifted"),
    )
    (first,), (second,) = (list(learner.learn(alone)) for learner, alone in (plain, shifted))  # type: ignore[arg-type]
    assert second.progress.return_mean == first.progress.return_mean
    assert second.progress.mean_policy_return == first.progress.mean_policy_return
    learner, alone = shifted
    steps, returns = alone.collect().steps[:8], alone.collect().returns[:8]
    assert len(set(steps.tolist())) > 1
    told = returns + 3.0 * (1.0 - 0.5**steps) / 0.5
    assert learner.state.best == pytest.approx(told.max())
    assert state(tmp_path / "plain") != state(tmp_path / "shifted")


def test_physics_that_always_blows_up_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fast.py").write_text(
        POLE.replace("        sim.qpos[row, 0] =", "        sim.qvel[row] = 1e30\n        sim.qpos[row, 0] =")
    )
    assert [report.progress.failed for report in learnt(configure("fast.py:Pole"), tmp_path / "r")] == [8, 8, 8]
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == [
        "all 8 rollouts became unstable: farm check shows how they start"
    ]


def test_a_full_disk_leaves_the_last_generation(pole: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, alone = begun(configure(pole), tmp_path / "r")
    reports: Iterator[Report] = learner.learn(alone)  # type: ignore[arg-type]
    next(reports)
    before = state(tmp_path / "r")

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, "save", full)
    with pytest.raises(RunError, match=r"No space left on device; the run is saved up to generation 1: make room and"):
        next(reports)
    monkeypatch.undo()
    assert learner.state.generation == 1
    assert state(tmp_path / "r") == before
    learner, alone = taken_up(tmp_path / "r")
    list(learner.learn(alone))  # type: ignore[arg-type]
    learnt(configure(pole), tmp_path / "whole")
    assert state(tmp_path / "r") == state(tmp_path / "whole")
    assert [p.generation for p in learner.folder.progress()] == [1, 2, 3]


# ---------------------------------------------------------------- resuming


def test_a_folder_that_was_removed_is_not_to_be_resumed(pole: str, tmp_path: Path) -> None:
    learner, alone = begun(configure(pole, generations=3), tmp_path / "r")
    reports = learner.learn(alone)  # type: ignore[arg-type]
    next(reports)
    shutil.rmtree(tmp_path / "r")
    with pytest.raises(RunError, match=r"r was removed or emptied while it learnt, after generation 1$"):
        next(reports)


def test_a_resumed_run_gives_the_same_numbers(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=4), tmp_path / "whole")
    learnt(configure(pole, generations=2), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=4)
    assert [report.progress.generation for report in learner.learn(alone)] == [3, 4]  # type: ignore[arg-type]
    assert state(tmp_path / "r") == state(tmp_path / "whole")
    assert learner.run == "r"
    assert taken_up(tmp_path / "r")[0].over


@pytest.mark.parametrize("algorithm", ["pgpe", "snes", "ars", "es", "cma-es", "sep-cma"])
def test_every_algorithm_is_resumed_to_the_same_bits(pole: str, tmp_path: Path, algorithm: str) -> None:
    def after(path: Path) -> dict[str, object]:
        values = checkpoints.load(path / "checkpoint").state
        return {name: v.tobytes() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    config = configure(pole, algorithm=algorithm, generations=6, policy="linear", normalise=True)
    reports = learnt(config, tmp_path / "whole")
    learnt(replace(config, generations=3), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=6)
    assert len(list(learner.learn(alone))) == 3  # type: ignore[arg-type]
    assert after(tmp_path / "r") == after(tmp_path / "whole")
    assert after(tmp_path / "whole")["generation"] == 6
    assert load(tmp_path / "whole", 5).rollout().trajectory.value == reports[5].progress.mean_policy_return


def test_other_settings_are_refused(pole: str, tmp_path: Path) -> None:
    config = configure(pole, generations=1)
    learnt(config, tmp_path / "r")
    with pytest.raises(CheckpointError, match="is of another configuration: --seed is 0 there and 5 in config.json"):
        taken_up(tmp_path / "r", seed=5)
    with pytest.raises(CheckpointError, match=r"--mass is 1\.0 there and 2\.0 in"):
        taken_up(tmp_path / "r", task_config=replace(config.task_config, mass=2.0))


def test_changed_code_is_refused_unless_numbers_may_differ(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    (tmp_path / "pole.py").write_text(POLE.replace("-np.abs", "-2.0 * np.abs"))
    with pytest.raises(CheckpointError, match=r"the code of its task has changed since the run began: .*--mixed"):
        taken_up(tmp_path / "r", generations=2)
    learner, alone = taken_up(tmp_path / "r", generations=2, mixed=True)
    assert [report.progress.generation for report in learner.learn(alone)] == [2]  # type: ignore[arg-type]
    (tmp_path / "pole.py").write_text(POLE)
    taken_up(tmp_path / "r", generations=3)


def test_a_run_goes_on_with_its_own_texts(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    assert at.files["note"] == "read by nobody"
    texts = at.files | {"model.xml": at.files["model.xml"].replace("0.1", "0.7")}
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, files=texts))
    learner, _ = taken_up(tmp_path / "r")
    assert learner.problem.task.model.dof_damping[0] == 0.7
    assert learner.spec.files == texts, "workers are told of them too"


def test_a_checkpoint_of_another_algorithms_state(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=1), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, state={**at.state, "velocity": np.zeros(9)}))
    with pytest.raises(CheckpointError, match="checkpoint: .*velocity"):
        taken_up(tmp_path / "r")


# ---------------------------------------------------------------- normalised observations


NORMALISED: dict[str, Any] = {"policy": "linear", "normalise": True, "initial_sigma": 0.5}


def observed(found: setup.Problem, rounds: list[tuple[int, Jobs, str]], mus: list[np.ndarray]) -> np.ndarray:
    """What the exploring rollouts of a run saw, one by one, each generation normalised by those before it."""
    parts, seen = [], [np.zeros((0, 2))]
    runner = found.runner()
    for (_, jobs, _), mu in zip(rounds, mus, strict=True):
        before = np.concatenate(seen)
        mean, deviation = (before.mean(axis=0), before.std(axis=0)) if len(before) else (np.zeros(2), np.ones(2))
        runner.policy = Normalised(found.policy, np.stack([mean, deviation]))
        for theta, seed in zip(jobs.theta(mu)[:8], jobs.seeds(), strict=False):
            rollouts = runner.rollouts(theta[None], [seed])
            qpos = np.concatenate([rollouts.start["qpos"], rollouts.frames["qpos"][0, :-1]])
            velocity = np.diff(np.concatenate([qpos[:1], qpos]), axis=0) / 0.02  # Euler's, from rest
            parts.append(np.concatenate([qpos, velocity], axis=1))
        seen = list(parts)
    return np.concatenate(parts)


def test_observations_are_normalised_by_all_generations_before(pole: str, tmp_path: Path) -> None:
    learner, alone = begun(configure(pole, **NORMALISED), tmp_path / "r")
    mus = []
    for _ in learner.learn(alone):  # type: ignore[arg-type]
        mus.append(np.array(RunFolder.open(tmp_path / "r").parameters.rows()["mu"][-1]))
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    x = observed(learner.problem, alone.rounds, [np.full(3, 1.0), *mus[:-1]])
    assert at.moments[0] == len(x) == 3 * 8 * 4, "exploring rollouts alone count"
    np.testing.assert_allclose(at.moments[1:3], x.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(at.moments[3:], x.var(axis=0) * len(x), rtol=1e-6)
    wanted = [normaliser(np.zeros(5)), *learner.folder.parameters.rows()["normaliser"]]
    for (_, jobs, _), sent, own in zip(alone.rounds, alone.normalisers, wanted, strict=False):
        assert sent[0].tobytes() == own.tobytes()
        assert jobs.rollouts.sum() >= 9
    assert wanted[-1].tobytes() == normaliser(at.moments).tobytes()


def test_a_normalised_run_is_the_same_in_any_order_and_after_a_resume(pole: str, tmp_path: Path) -> None:
    def after(path: Path) -> tuple[bytes, ...]:
        at = checkpoints.load(path / "checkpoint")
        assert at.best is not None
        return (*state(path), at.moments.tobytes(), at.best.normaliser.tobytes())

    learnt(configure(pole, **NORMALISED, generations=6), tmp_path / "whole")
    found, at = setup.start(configure(pole, **NORMALISED, generations=6), "other")
    folder = RunFolder.create(tmp_path / "other", found.config)
    list(Learner(found, folder, at).learn(Alone(found, seed=5)))  # type: ignore[arg-type]
    learnt(configure(pole, **NORMALISED, generations=3), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=6)
    list(learner.learn(alone))  # type: ignore[arg-type]
    assert after(tmp_path / "whole") == after(tmp_path / "other") == after(tmp_path / "r")
    plain = learnt(configure(pole, **{**NORMALISED, "normalise": False}, generations=6), tmp_path / "plain")
    assert plain[-1].progress.return_mean != learner.folder.progress()[-1].return_mean


def test_every_policy_of_a_normalised_run_is_seen_as_it_was(pole: str, tmp_path: Path) -> None:
    reports = learnt(configure(pole, **NORMALISED, generations=REPLAY_EVERY + 2), tmp_path / "r")
    for generation in (0, 1, 5, REPLAY_EVERY + 1):
        earlier = load(tmp_path / "r", generation)
        assert earlier.rollout().trajectory.value == reports[generation].progress.mean_policy_return
    shown = [report for report in reports if report.replay is not None]
    assert shown
    for report in shown:  # the best rollout so far, in a round whose observations are normalised otherwise
        assert report.replay is not None
        assert report.replay.value == reports[report.progress.generation - 2].progress.best


def test_a_run_that_starts_from_a_normalised_one_goes_on_with_its_statistics(pole: str, tmp_path: Path) -> None:
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
    with pytest.raises(CheckpointError, match="its statistics are of other observations than its task's"):
        taken_up(tmp_path / "r", generations=2)


# ---------------------------------------------------------------- beginning from another run


def test_a_run_that_starts_from_another(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, seed=3), tmp_path / "first")
    other = checkpoints.load(tmp_path / "first" / "checkpoint")
    for sigma in ("run", "fresh"):
        config = configure(pole, seed=4, init_from=str(tmp_path / "first"), init_sigma=sigma, initial_sigma=0.5)
        found, at = setup.start(config, "second")
        assert at.state["mu"].tobytes() == other.state["mu"].tobytes()
        assert (at.state["sigma"].tobytes() == other.state["sigma"].tobytes()) == (sigma == "run")
        assert at.state["generation"] == 0
        for name, values in other.constants.items():
            assert found.policy.constants[name].tobytes() == values.tobytes(), "else its parameters mean something else"


def test_an_mlp_starts_at_drawn_weights_which_a_run_to_start_from_replaces(pole: str, tmp_path: Path) -> None:
    mlp: dict[str, Any] = {"policy": "mlp", "layers": (3,), "algorithm": "es", "generations": 2}
    config = configure(pole, **mlp)
    found, at = setup.start(config, "first")
    drawn = found.policy.start(seeds.start(config.seed))
    assert drawn is not None
    assert at.state["mu"].tobytes() == drawn.tobytes()
    raised = setup.start(configure(pole, **mlp, initial_mu=0.5), "first")[1]
    assert raised.state["mu"].tobytes() == (0.5 + drawn).tobytes()
    assert not at.constants, "workers need no start"
    learnt(config, tmp_path / "first")
    assert load(tmp_path / "first", 0).mu.tobytes() == drawn.tobytes()
    other = checkpoints.load(tmp_path / "first" / "checkpoint").state["mu"]
    _, taken = setup.start(configure(pole, **mlp, seed=4, init_from=str(tmp_path / "first")), "second")
    assert taken.state["mu"].tobytes() == other.tobytes()


def test_a_run_whose_parameters_mean_something_else_is_no_beginning(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole), tmp_path / "first")
    for changed, words in (
        ({"features": 4}, "its parameters mean something else"),
        ({"policy": "cosine"}, r"its parameters mean something else \(direct, not cosine\)"),
    ):
        with pytest.raises(ConfigError, match=words):
            setup.start(configure(pole, init_from=str(tmp_path / "first"), **changed), "second")
    with pytest.raises(ConfigError, match="is not a run's folder"):
        setup.start(configure(pole, init_from=str(tmp_path)), "second")


# ---------------------------------------------------------------- a start that fits the observation


@pytest.mark.parametrize(("policy", "own"), [("kernel", {}), ("projected", {"features": 5})])
def test_a_fitted_start(pole: str, policy: str, own: dict[str, Any]) -> None:
    config = configure(pole, policy=policy, initial_mu=1.5, start="fitted", **own)
    found = setup.fitted(config)
    distance = np.hypot(1.5 - 0.2, 1.5)  # qpos and qvel at the start
    width, sigma = found.policy_config.bandwidth, found.algorithm_config.initial_sigma  # type: ignore[attr-defined]
    assert distance**2 / (2 * width**2) == pytest.approx(1.0)
    assert 2 * sigma**2 / (2 * width**2) == pytest.approx(1.0)
    assert setup.fitted(found) == found, "so that config.json repeats the run"
    state = setup.start(found, "r")[1].state
    assert (state["mu"] == 1.5).all()
    assert (state["sigma"] == sigma).all()
    printed = replace(config, start="printed")
    assert setup.fitted(printed) is printed


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "--start fitted is for the policies kernel and projected, not direct"),
        ({"policy": "kernel", "init_from": "x"}, "--start fitted and --init-from exclude each other"),
        ({"policy": "kernel", "normalise": True}, "--start fitted and --normalise exclude each other"),
    ],
)
def test_a_start_that_cannot_be_fitted(pole: str, changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        setup.fitted(configure(pole, start="fitted", **changed))


def test_a_fitted_start_begins_beside_the_observation(pole: str, tmp_path: Path) -> None:
    (tmp_path / "pole.py").write_text(POLE.replace("0.2 if rng", "0.0 if rng"))
    with pytest.raises(ConfigError, match="--initial-mu is the observation at the start; take another"):
        setup.fitted(configure(pole, policy="kernel", initial_mu=0.0, start="fitted"))


def test_the_finger_gaits_start_fits_every_state_base() -> None:
    sizes = {"joints": 8, "joints+contacts": 17, "tactile": 54, "joints+tactile": 62}
    for state, size in sizes.items():
        found = setup.fitted(configure(state=state, start="fitted"))
        width = found.policy_config.bandwidth  # type: ignore[attr-defined]
        policy = setup.start(found, "r")[0].policy
        assert 0.1 < width < 10.0
        assert found.algorithm_config.initial_sigma == pytest.approx(width * np.sqrt(2 / size))  # type: ignore[attr-defined]
        assert policy.size == 8 * size


# ---------------------------------------------------------------- what workers are told


def test_what_workers_are_told_is_the_problem(pole: str, tmp_path: Path) -> None:
    found, _ = setup.start(configure(pole, mass=2.0), "r")
    spec = found.specification("r")
    assert (spec.task, found.files) == ("pole.py:Pole", (tmp_path / "pole.py",))
    task, policy = served(spec, found.files)
    assert (task.config, task.sources) == (found.task.config, found.task.sources)
    assert policy.constants.keys() == found.policy.constants.keys()
    theta = np.ones((2, policy.size))
    x = np.ones((2, policy.spec.observation))
    assert policy.act(policy.prepare(theta), x).tobytes() == found.policy.act(found.policy.prepare(theta), x).tobytes()
    assert found.code["task"] == plugins.find("tasks", pole).digest()


# ---------------------------------------------------------------- loading


def test_a_policy_that_was_learnt(pole: str, tmp_path: Path) -> None:
    reports = learnt(configure(pole), tmp_path / "r")
    policy = farm.load(tmp_path / "r")
    assert policy.generation == 3
    assert policy.mu.tobytes() == state(tmp_path / "r")[0]
    for generation in range(3):  # a generation shows the mean that it explored around
        earlier = load(tmp_path / "r", generation)
        assert earlier.rollout().trajectory.value == reports[generation].progress.mean_policy_return
    with pytest.raises(ConfigError, match="generation 7 is not stored in .*: stored are 1 to 3, the nearest is 3"):
        load(tmp_path / "r", 7)
    with pytest.raises(ConfigError, match=r"no settings of .*:Pole: friction"):
        load(tmp_path / "r", friction=0.5)


def test_a_policy_under_other_settings_keeps_the_runs_texts(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole), tmp_path / "r")
    at = checkpoints.load(tmp_path / "r" / "checkpoint")
    texts = at.files | {"model.xml": at.files["model.xml"].replace("0.1", "0.7")}
    checkpoints.save(tmp_path / "r" / "checkpoint", replace(at, files=texts))
    own, heavy = load(tmp_path / "r"), load(tmp_path / "r", mass=5.0)
    assert own.problem.task.sources == heavy.problem.task.sources == texts
    assert (own.problem.task.model.body_mass[1], heavy.problem.task.model.body_mass[1]) == (1.0, 5.0)
    assert own.rollout().trajectory.value != heavy.rollout().trajectory.value
    copied = shutil.copytree(tmp_path / "r", tmp_path / "copy")
    assert load(copied).rollout().trajectory.value == own.rollout().trajectory.value


def test_another_object_in_the_hand_of_the_run(tmp_path: Path) -> None:
    """The hand is the run's, whatever this machine's is; the object is the one that was asked for."""
    config = configure()
    at = setup.start(config, "r")[1]
    folder = RunFolder.create(tmp_path / "r", config)
    texts = at.files | {"hand.xml": at.files["hand.xml"].replace("<mujoco", "<!-- the run's -->\n<mujoco", 1)}
    assert texts != at.files
    checkpoints.save(folder.checkpoint, replace(at, files=texts))
    found = load(folder.path, object="cylinder").problem.task
    assert found.sources["hand.xml"] == texts["hand.xml"]
    assert found.sources["object.xml"] != texts["object.xml"]
    assert found.config.object == "cylinder"
    assert load(folder.path).problem.task.sources == texts
