"""A run without a network: how it begins, goes on, is resumed, and what is loaded of it afterwards."""

import errno
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import farm
from farm import plugins
from farm.errors import CheckpointError, ConfigError, RunError
from farm.net.work import Jobs, Results
from farm.rollouts import served
from learner import checkpoint as checkpoints
from learner import setup
from learner.config import RunConfig, configure
from learner.learner import REPLAY_EVERY, Learner
from learner.replay import load
from learner.run import _resumed
from learner.run_folder import RunFolder
from learner.scheduler.round import RoundResults
from learner.telemetry.report import Report

POLE = """
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
import farm

MODEL = '''<mujoco><option timestep="0.02"/><worldbody><body><joint name="j" axis="0 1 0" damping="0.1"/>
  <geom size="0.1" mass="MASS"/></body></worldbody><actuator><motor joint="j"/></actuator></mujoco>'''

class Pole(farm.Task):
    presets: ClassVar = {"default": {"features": 3, "pairs": 4, "generations": 3}}
    steps = 4
    channels = (farm.Channel(name="angle", kind="scalars", shape=(1,), trace=True),)

    @dataclass(frozen=True, kw_only=True)
    class Config(farm.TaskConfig):
        mass: float = farm.setting(1.0, above=0.0)

    def files(self):
        return {"model.xml": MODEL, "note": "read by nobody"}

    def mjcf(self):
        return self.sources["model.xml"].replace("MASS", str(self.config.mass))

    def reset(self, sim, row, rng):
        sim.qpos[row, 0] = 0.2 if rng is None else rng.uniform(-0.3, 0.3)

    def reward(self, sim, action):
        return -np.abs(sim.qpos[:, 0])

    def success(self, sim):
        return sim.qpos[:, 0] > -9.0

    def measure(self, sim):
        return {"angle": sim.qpos}
"""


class Alone:
    """In the dispatcher's place: does a round's jobs here and now, some of them at a time, in any order."""

    def __init__(self, found: setup.Problem, seed: int = 0) -> None:
        self.admission, self.workers, self.reissued = SimpleNamespace(canary="c"), ("w/1",), 0
        self.problem, self._runner, self._rng = found, found.runner(), np.random.default_rng(seed)
        self.rounds: list[tuple[int, Jobs, str]] = []

    def begin(self, generation: int, mu: np.ndarray, jobs: Jobs, traces: str = "none") -> None:
        self.rounds.append((generation, jobs, traces))
        shapes = self.problem.spec.shapes(len(self.problem.scene.bodies))
        self._round = RoundResults(jobs, traces, self.problem.spec.trace, shapes)
        for some in np.array_split(self._rng.permutation(len(jobs)), 3):
            part = jobs.take(sorted(some.tolist()))
            given = self._runner.run(mu, part, traces)
            said = Results.carrying(given, part, run="r", incarnation="i", round=0, worker="w/1")
            place = self._round.place(said)
            assert place is not None
            self._round.put(said, place, np.ones(len(part), bool))

    def collect(self) -> RoundResults:
        return self._round

    def report(self, progress: object) -> None:
        pass


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
    found, at = _resumed(folder, config, mixed=mixed)
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


def test_solved_often_enough_is_the_end(pole: str, tmp_path: Path) -> None:
    assert len(learnt(configure(pole, generations=9, stop_when_solved=2), tmp_path / "r")) == 2
    plain = tmp_path / "plain.py"
    plain.write_text(POLE.replace("def success", "def judged"))
    config = configure(f"{plain}:Pole", stop_when_solved=2)
    with pytest.raises(ConfigError, match=r"--stop-when-solved: .*:Pole knows returns, but no success"):
        setup.problem(config)


def test_physics_that_always_blows_up_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fast.py").write_text(
        POLE.replace("        sim.qpos[row, 0] =", "        sim.qvel[row] = 1e30\n        sim.qpos[row, 0] =")
    )
    assert [report.progress.failed for report in learnt(configure("fast.py:Pole"), tmp_path / "r")] == [8, 8, 8]
    assert [r.getMessage() for r in caplog.records if r.levelname == "WARNING"] == [
        "the physics of all 8 rollouts blew up: farm check shows how they start"
    ]


def test_a_full_disk_leaves_the_last_generation(pole: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, alone = begun(configure(pole), tmp_path / "r")
    reports: Iterator[Report] = learner.learn(alone)  # type: ignore[arg-type]
    next(reports)
    before = state(tmp_path / "r")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoints, "save", full)
    with pytest.raises(RunError, match=r"No space left on device; the run stands as of generation 1: make room and"):
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


def test_a_resumed_run_gives_the_same_numbers(pole: str, tmp_path: Path) -> None:
    learnt(configure(pole, generations=4), tmp_path / "whole")
    learnt(configure(pole, generations=2), tmp_path / "r")
    learner, alone = taken_up(tmp_path / "r", generations=4)
    assert [report.progress.generation for report in learner.learn(alone)] == [3, 4]  # type: ignore[arg-type]
    assert state(tmp_path / "r") == state(tmp_path / "whole")
    assert learner.run == "r"
    assert taken_up(tmp_path / "r")[0].over


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
    with pytest.raises(ConfigError, match="generation 7 is not stored in .*: 3 from 1 to 3 are, the nearest is 3"):
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
