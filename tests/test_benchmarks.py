"""The benchmarks' scripts run and print the expected rows; no test measures speed."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from farm.errors import FarmError
from farm.net.session import free_endpoint
from farm.seeds import evaluation_start
from farm.sim.sim import Sim
from farm.tasks.finger_gait.hand import JOINTS, TIP_RADIUS
from learner.pool.placement import Placement
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.launch import open_run
from learner.run.setup import problem
from learner.tools.replay.loaded import LoadedPolicy

FOLDER = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "rows"),
    [
        ("grips.py", 11),
        ("environments.py --rollouts 2 --steps 3 --repeats 1", 10),
        ("timeline.py --pairs 2 --generations 9", 6),
        ("scaling.py --workers 2,5 --pair 0.001 --seconds 0.5", 5),
        ("large.py --workers 2,5 --pair 0.001 --seconds 0.5", 2),
        ("memory.py --tasks finger-gait --workers 1", 1),
        ("start.py --turns 1", 15),
        ("films.py --pictures 1 finger-gait", 1),
        ("long_runs.py --generations 300 --pairs 1", 13),
        (
            (
                "own_tasks.py --tasks Hopper --methods still,pycma --seeds 1 --rollouts 100 --out"
                " /dev/null"
            ),
            1,
        ),
    ],
    ids=lambda value: str(value).partition(".")[0],
)
def test_they_print_their_tables(words: str, rows: int) -> None:
    pytest.importorskip("gymnasium")
    name, *arguments = words.split()
    done = subprocess.run(
        [sys.executable, FOLDER / name, *arguments],
        env={"MUJOCO_GL": "osmesa", **os.environ},
        capture_output=True,
        text=True,
        check=False,
    )
    if "MuJoCo cannot draw here" in done.stderr:
        pytest.skip("needs OSMesa (Debian: libosmesa6)")
    assert done.returncode == 0, done.stderr
    lines = [line.strip() for line in done.stdout.splitlines() if line.startswith("|")]
    heads = sum(line.startswith("|--") for line in lines)
    assert len(lines) - 2 * heads == rows, done.stdout
    assert all(line.count("|") >= 3 for line in lines)


@pytest.mark.parametrize(
    ("name", "table", "page", "lines"),
    [
        ("own_tasks", "own-tasks", "docs/results/own-tasks.md", 11),
        ("own_tasks", "held-tasks", "docs/results/own-tasks.md", 10),
        ("learning_speed", "learning-speed", "benchmarks/README.md", 8),
        ("cycles", "cycles", "docs/results/chain-of-gaits.md", 27),
        ("lens", "lens", "docs/results/turning.md", 23),
        ("lens --task Cube --seconds 120", "lens", "docs/results/turning.md", 10),
        ("lens_estimate", "lens-estimate", "docs/results/turning.md", 8),
        ("lens_ablations", "lens-ablations", "docs/results/turning.md", 11),
        ("lens_elsewhere", "lens-elsewhere", "docs/results/turning.md", 41),
        ("lens_objects", "lens-objects", "docs/results/turning.md", 18),
        ("steer --task Lens", "steer", "docs/results/turning.md", 13),
        ("steer", "steer", "docs/results/turning.md", 13),
    ],
)
def test_a_page_shows_the_recorded_table(name: str, table: str, page: str, lines: int) -> None:
    file = FOLDER.parent / f"docs/results/tables/{table}.jsonl"
    script, *flags = name.split()
    words = [*flags, "--out", file, "--table"]
    done = subprocess.run(
        [sys.executable, FOLDER / f"{script}.py", *words],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("\n") == lines
    assert done.stdout in (FOLDER.parent / page).read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("lens.py --seconds 20", "argument --seconds: expected 120, 130, ... or 1000"),
        ("lens.py --table --out docs", "docs: [Errno 21] Is a directory: 'docs'; name a different"),
        ("lens_ablations.py --starts 0", "argument --starts: expected a whole number from 1"),
        ("lens_estimate.py --noise 0,x", "argument --noise: expected numbers from 0 with commas"),
        (
            "lens_estimate.py --table --out docs/results/tables/lens.jsonl",
            "docs/results/tables/lens.jsonl: its rows are another script's; name a different file",
        ),
        ("steer.py --seeds 1;2", "argument --seeds: expected whole numbers with commas between"),
    ],
)
def test_an_odd_flag_of_a_table_gets_one_line(words: str, line: str) -> None:
    name, *arguments = words.split()
    done = subprocess.run(
        [sys.executable, FOLDER / name, *arguments],
        cwd=FOLDER.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert line in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_the_survival_of_lenses_is_drawn(tmp_path: Path) -> None:
    figure = tmp_path / "lens.svg"
    words = ["--table", "--figure", figure]
    subprocess.run([sys.executable, FOLDER / "lens.py", *words], check=True, capture_output=True)
    drawn = figure.read_text("utf-8")
    for name in ("still", "touch", "touch, of another rollout", "lenses that are kept [%]"):
        assert f">{name}</text>" in drawn


@pytest.mark.slow
def test_the_cycles_estimate_tells_where_the_bar_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import cycles

    settings: dict[str, Any] = {"object": "crowned-bar", "state": "estimate"}
    runner = problem(configure(cycles.TASK, weights=cycles.estimate(settings), **settings)).runner()
    observe, estimates, places = runner.task.observe, [], []

    def noted(sim: Sim) -> np.ndarray:
        observed: np.ndarray = observe(sim)
        estimates.append(sim.own["estimate"].copy())
        places.append(
            (sim.qpos[:, len(JOINTS)] - runner.task.model.qpos0[len(JOINTS)]) / TIP_RADIUS
        )
        return observed

    monkeypatch.setattr(runner.task, "observe", noted)
    runner.rollouts(np.zeros((50, runner.size)), [evaluation_start(1, i) for i in range(50)])
    place = np.concatenate(places)  # [fingertip radii]
    wrong = place - np.concatenate(estimates)
    assert np.mean(wrong**2) < 0.5 * np.mean(place**2), "more than half is known, from other starts"


@pytest.mark.slow
def test_the_lens_s_estimate_tells_what_touch_would(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import lens
    import lens_estimate

    config = configure(f"{lens.FILE}:Lens", steps=40, joint_noise=0.0, strict=True)
    made = problem(config)
    policy = LoadedPolicy(made, 0, np.zeros(made.policy.size))
    estimate = lens_estimate.Estimate()
    estimate.install(policy)
    thetas = 0.01 * np.random.default_rng(0).standard_normal((200, policy.mu.size))
    policy.runner.rollouts(thetas, [evaluation_start(3, i) for i in range(200)])
    estimate.fit()
    assert estimate.share() > 0.9

    other = LoadedPolicy(problem(config), 0, policy.mu)
    felt: list[np.ndarray] = []
    estimates: list[np.ndarray] = []

    def noted(seen: Callable[[Sim], np.ndarray], values: list[np.ndarray]) -> Any:
        def noting(sim: Sim) -> np.ndarray:
            value = seen(sim)
            if sim.t >= lens_estimate.CYCLE:
                values.append(value)
            return value

        return noting

    task: Any = other.runner.task
    task.seen = noted(task.seen, felt)
    estimate.install(other)
    task.seen = noted(task.seen, estimates)
    # Starts to which nothing was fitted
    other.runner.rollouts(thetas[:50], [evaluation_start(4, i) for i in range(50)])
    wrong = np.concatenate(felt) - np.concatenate(estimates)
    assert np.mean(wrong**2) < 0.3 * np.concatenate(felt).var(axis=0).mean()


def test_a_return_is_reached_by_three_means_in_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import learning_speed

    class Known:
        def run(self, mean: np.ndarray, _: object, normaliser: np.ndarray) -> SimpleNamespace:
            assert normaliser.shape == (2, 2, 0)
            return SimpleNamespace(returns=np.repeat(mean, learning_speed.STARTS + 1))

    def reached(returns: list[float]) -> tuple[int, float] | None:
        means = [
            (10 * (i + 1), float(i), np.array([each]), np.empty((2, 0)))
            for i, each in enumerate(returns)
        ]
        result: tuple[int, float] | None = learning_speed.reached(Known(), iter(means), 1.0)
        return result

    assert reached([0.0, 1.0, 2.0, 0.9, 1.0, 1.0, 3.0, 0.0]) == (50, 4.0)
    assert reached([1.0, 1.0, 0.0, 1.0, 1.0]) is None
    assert reached([]) is None


def test_the_pages_show_the_recorded_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import peers

    data = json.loads((FOLDER.parent / "docs/results/tables/peers.json").read_text("utf-8"))
    assert "\n".join(peers.first_page(data)) in (FOLDER.parent / "README.md").read_text("utf-8")
    _, _, *tables = peers.table(data)
    assert "\n".join(tables) in (FOLDER / "README.md").read_text("utf-8")


def test_numbers_of_a_machine_that_is_not_steady_are_shown_and_not_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import peers

    data = json.loads((FOLDER.parent / "docs/results/tables/peers.json").read_text("utf-8"))
    for name in peers.PHYSICS:
        data["backends"][name]["rounds"]["gait15"][0]["wall"] *= 10.0
    monkeypatch.setattr(peers, "_measured", lambda *_: data)
    monkeypatch.setattr(sys, "argv", ["peers.py", "--out", str(tmp_path / "peers.json")])
    with pytest.raises(FarmError, match="the machine is not steady: "):
        peers.main()
    assert "| multiprocessing.Pool(2) |" in capsys.readouterr().out
    assert not (tmp_path / "peers.json").exists()


def test_the_map_of_touch_shows_the_recorded_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import touch_map

    results = FOLDER.parent / "docs/results"
    data = json.loads((results / "touch/map.json").read_text("utf-8"))
    assert touch_map.tables(data) in (results / "touch.md").read_text("utf-8")
    assert touch_map.least(200, 146) == pytest.approx(0.2, abs=0.02), "of 1.0 - 0.73"


@pytest.mark.slow
def test_ctrl_c_ends_a_script_with_one_line() -> None:
    command = [sys.executable, "-u", FOLDER / "early.py"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # In the background Ctrl-C is ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        assert process.stdout
        process.stdout.readline()  # the table's head, before the first run
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "stopped before the end\n")


@pytest.mark.slow
def test_an_interrupted_run_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    from running import learn

    config = configure(generations=6, pairs=2)
    learn(config, tmp_path / "whole", workers=1)
    interrupt(config, tmp_path / "parts", after=3)
    assert hash_of(tmp_path / "parts") != hash_of(tmp_path / "whole")
    learn(config, tmp_path / "parts", workers=1)
    assert hash_of(tmp_path / "parts") == hash_of(tmp_path / "whole")
    written = (tmp_path / "parts/summary.json").stat().st_mtime_ns
    learn(config, tmp_path / "parts", workers=1)
    assert (tmp_path / "parts/summary.json").stat().st_mtime_ns == written, (
        "a finished run is not repeated"
    )


@pytest.mark.slow
def test_the_fragile_bar_needs_no_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    from touch import FITS, Zeroed

    runner = problem(configure("fragile-bar", joint_bias=0.2)).runner()
    try:
        success = Zeroed(runner, FITS[:64]).rollouts([(2, 0, 78, i) for i in range(64)])[0]
    finally:
        runner.close()
    assert success.mean() >= 0.95


@pytest.mark.slow
def test_a_kalman_filter_feels_without_touch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)
    import touch_controllers

    cell = {"joint_drift": 0.002, "joint_noise": 0.02, "joint_bias": 0.2}
    runner = problem(configure("fragile-bar", **cell)).runner()
    try:
        closing = touch_controllers.play(runner, touch_controllers.FITS, None, 0.0, 0.02)
        (kalman,) = touch_controllers.Kalman.fitted(closing, cell)
        starts = [(2, 0, 78, i) for i in range(64)]
        seeing, still = (
            touch_controllers.play(runner, starts, each, 0.02).success for each in (kalman, None)
        )
    finally:
        runner.close()
    assert seeing.mean() >= 0.75
    assert still.mean() == 0.0


def interrupt(config: RunConfig, path: Path, after: int) -> None:
    place = Placement(workers=1, listen=free_endpoint())
    with open_run(config, path, place) as run:
        reports = run.learn()
        for _ in range(after):
            next(reports)
        reports.close()


def hash_of(path: Path) -> str:
    return (RunFolder(path).read_summary() or {})["parameters_sha256"]


def test_the_gallery_shows_the_recorded_scores(tmp_path: Path) -> None:
    docs, table = FOLDER.parent / "docs", "results/tables/gallery.jsonl"
    (tmp_path / table).parent.mkdir(parents=True)
    shutil.copy(docs / table, tmp_path / table)
    words = ["--only", "none", "--docs", tmp_path]
    subprocess.run([sys.executable, FOLDER / "gallery.py", *words], check=True)
    page = (tmp_path / "gallery.md").read_text("utf-8")
    assert page == (docs / "gallery.md").read_text("utf-8")
    assert page.count("](pictures/gallery/") == 14
    assert sum(film.stat().st_size for film in (docs / "pictures/gallery").iterdir()) < 6e6
    sizes = [
        each.stat().st_size
        for part in ("pictures", "results")
        for each in (docs / part).rglob("*.*")
    ]
    assert sum(sizes) < 8e6
    for row in map(json.loads, (docs / table).read_text().splitlines()):
        assert row["learnt"] > max(row["constant"], row["still"]), row["task"]
