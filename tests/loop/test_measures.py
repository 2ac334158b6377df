"""Measures beside the return: from a task to evaluations, progress, summary, tables and the
recording.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning import learnt
from rerun.chunk import RrdReader

import farm
from farm.__main__ import main
from farm.errors import ConfigError, RunError, TaskError
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.setup import problem

TASK = '''
import numpy as np
from farm import Channel, Measure, Task

FAR = Measure(name="farthest", low=0.0, high=2.0, unit="m")
PUSH = Measure(name="push", low=0.0, high=1.0)

class Cart(Task):
    """Bring a cart to where it should be; it says how far it was and how hard it was pushed."""

    xml = """<mujoco>
      <worldbody>
        <body name="cart">
          <joint name="x" type="slide" axis="1 0 0" damping="1"/>
          <geom size="0.1" mass="1"/>
        </body>
      </worldbody>
      <actuator><motor joint="x" ctrlrange="-2 2"/></actuator>
    </mujoco>"""
    steps, substeps = 20, 5
    channels = (Channel(name="place", kind="scalars", shape=(1,), unit="m", trace=True),)
    measures = (FAR, PUSH)

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.5 if rng is None else rng.uniform(0.3, 0.7)

    def measure(self, sim):
        return {"place": sim.qpos}

    def reward(self, sim, action):
        return {"near": -np.abs(sim.qpos[:, 0]), "calm": -0.1 * action[:, 0] ** 2}

    def ended(self, sim):
        return sim.qpos[:, 0] < 0.4

    def outcomes(self, record):
        there = np.arange(self.steps) < record.steps[:, None]
        far = np.where(there, np.abs(record.frames["place"][:, :, 0]), 0.0).max(axis=1)
        push = np.minimum(np.abs(record.actions[:, :, 0]), 1.0)
        pushed = np.where(there, push, 0.0).sum(axis=1) / record.steps
        return {"push": pushed, "farthest": far.clip(0.0, 2.0)}
'''
SMALL: dict[str, Any] = {"generations": 3, "pairs": 4, "policy": "linear", "initial_sigma": 0.5}


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    path = tmp_path / "mine" / "cart.py"
    path.parent.mkdir()
    path.write_text(TASK)
    return path


def small(cart: Path, **more: Any) -> RunConfig:
    return configure(f"{cart}:Cart", **(SMALL | more))


# ---------------------------------------------------------------- evaluations


@pytest.fixture
def pool(cart: Path) -> Iterator[farm.Farm]:
    with farm.Farm(f"{cart}:Cart", policy="linear", gamma=0.9, workers=2) as opened:
        yield opened


def test_an_evaluation_has_everything_in_order_and_the_same_bits_as_one_process(
    pool: farm.Farm, cart: Path
) -> None:
    thetas, seeds = np.random.default_rng(0).normal(size=(30, pool.size)), range(30)
    runner = problem(configure(f"{cart}:Cart", policy="linear", gamma=0.9)).runner()
    one = [runner.rollouts(thetas[i : i + 1], [(4, 0, i, 0)]) for i in range(30)]
    outcome = pool.evaluate(thetas, seeds, traces=True)
    assert (
        outcome.returns.tobytes()
        == b"".join(each.returns.tobytes() for each in one)
        == pool.map(thetas, seeds).tobytes()
    )
    assert outcome.measures.tobytes() == b"".join(each.measures.tobytes() for each in one)
    assert outcome.steps.tolist() == [int(each.steps[0]) for each in one]
    assert len(set(outcome.steps.tolist())) > 1, "some end early"
    assert (outcome.success, outcome.failed.any()) == (None, False)
    assert pool.spec.terms == ("near", "calm")
    np.testing.assert_allclose(outcome.terms.sum(axis=1), outcome.returns, rtol=1e-12)
    weights = 0.9 ** np.arange(20)
    for i, each in enumerate(one):
        np.testing.assert_allclose(
            outcome.terms[i], (each.terms[0] * weights[:, None]).sum(axis=0), rtol=1e-12
        )
        assert outcome.traces is not None
        np.testing.assert_array_equal(
            outcome.traces[i, : outcome.steps[i]],
            each.frames["place"][0, : outcome.steps[i]].astype("<f4"),
        )
    farthest, push = outcome.measures.T
    assert [each.name for each in pool.spec.measures] == ["farthest", "push"]
    assert (farthest > 0.29).all()
    assert push.min() < 0.5 < push.max() <= 1.0
    # In another order, and others beside them: the same.
    again = pool.evaluate(thetas[::-1], list(seeds)[::-1])
    assert again.measures[::-1].tobytes() == outcome.measures.tobytes()
    assert again.traces is None


def test_nothing_to_evaluate(pool: farm.Farm) -> None:
    outcome = pool.evaluate([], traces=True)
    assert (outcome.measures.shape, outcome.terms.shape) == ((0, 2), (0, 2))
    assert outcome.traces is not None
    assert outcome.traces.shape == (0, 20, 1)


def test_a_task_without_measures_or_traces(cart: Path) -> None:
    lines = TASK.replace(", trace=True", "").partition("    def outcomes")[0].splitlines()
    cart.write_text("\n".join(line for line in lines if "measures =" not in line))
    with farm.Farm(f"{cart}:Cart", policy="linear", workers=1) as pool:
        outcome = pool.evaluate(np.zeros((3, pool.size)))
        assert (outcome.measures.shape, outcome.terms.shape) == ((3, 0), (3, 2))
        with pytest.raises(ConfigError, match="^traces: no channel of the task has trace=True$"):
            pool.evaluate(np.zeros((3, pool.size)), traces=True)


def test_a_measure_outside_its_bounds_is_named(cart: Path) -> None:
    cart.write_text(TASK.replace("far.clip(0.0, 2.0)", "far + 5.0"))
    with farm.Farm(f"{cart}:Cart", policy="linear", workers=1) as pool:
        with pytest.raises(
            RunError,
            match=r"measure 'farthest' is 5\.\d+; its bounds are 0 to 2: widen them, or clip",
        ):
            pool.evaluate(np.zeros((1, pool.size)))


# ---------------------------------------------------------------- a task's mistakes


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"push": pushed', '"shove": pushed', "outcomes 'push' gave a NoneType"),
        ('return {"push"', 'return 3 or {"push"', "outcomes gave a int; expected arrays by name"),
        ("far.clip(0.0, 2.0)", "far * np.nan", "measure 'farthest' is nan; its bounds are 0 to 2"),
        ("far.clip(0.0, 2.0)", "record.frames['place']", r"outcomes 'farthest'.* \(1, 20, 1\)"),
    ],
)
def test_wrong_outcomes_are_one_line(cart: Path, old: str, new: str, reason: str) -> None:
    assert old in TASK
    cart.write_text(TASK.replace(old, new))
    runner = problem(small(cart)).runner()
    with pytest.raises(TaskError, match=reason) as error:
        runner.rollouts(np.zeros((1, runner.size)), [None])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (
            'name="push"',
            'name="farthest"',
            "task Cart: two measures are named alike: farthest, farthest",
        ),
        ('name="push"', 'name="a b"', "measure 'a b': expected a name of letters, digits and _"),
        (
            'name="push"',
            'name="return"',
            "measure return: all rollouts have a number of this name .*; call it otherwise",
        ),
        (
            "low=0.0, high=1.0",
            "low=1.0, high=1.0",
            "measure push: bounds 1.0 to 1.0; expected rising numbers",
        ),
        (
            "low=0.0, high=1.0",
            "low=0.0, high=float('inf')",
            "measure push: bounds 0.0 to inf; expected rising numbers",
        ),
        (
            "measures = (",
            "measures = 3, (",
            r"measures is \(3, .*; expected a tuple of farm.Measure",
        ),
    ],
)
def test_wrong_measures_are_one_line(cart: Path, old: str, new: str, reason: str) -> None:
    assert old in TASK
    cart.write_text(TASK.replace(old, new))
    with pytest.raises(ConfigError, match=reason):
        problem(small(cart))


def test_an_unstable_rollout_has_the_lowest_measures_and_no_terms(cart: Path) -> None:
    cart.write_text(
        TASK.replace(
            "    def measure(",
            "    def act(self, sim, action):\n        sim.qpos[:] *= 1e9\n"
            "        return super().act(sim, action)\n\n    def measure(",
        )
    )
    runner = problem(small(cart)).runner()
    rollouts = runner.rollouts(np.zeros((2, runner.size)), [None, None])
    assert rollouts.failed.all()
    assert rollouts.measures.tolist() == [[0.0, 0.0]] * 2


# ---------------------------------------------------------------- a run


@pytest.mark.slow
def test_progress_and_summary_have_measures_and_workers_do_not_matter(
    cart: Path, tmp_path: Path
) -> None:
    one, two = (learnt(small(cart), tmp_path / str(count), count, cart) for count in (1, 2))
    lines = [RunFolder.open(tmp_path / name).progress() for name in "12"]
    measures = [[(each.measures, each.mean_policy_measures) for each in run] for run in lines]
    assert measures[0] == measures[1]
    assert measures[0][0][1]["farthest"] == pytest.approx(0.5, abs=1e-3), (
        "a policy of zeros leaves it where it was"
    )
    assert measures[0][0][1]["push"] == 0.0
    assert 0.0 < measures[0][0][0]["push"] < 1.0
    assert one["mean_policy_measures"] == two["mean_policy_measures"]
    assert 0.29 < one["robust_measures"]["farthest"] < 1.0
    learnt(small(cart, generations=1), tmp_path / "half", 1, cart)
    learnt(small(cart), tmp_path / "half", 1, cart, resume=True)
    assert [each.measures for each in RunFolder.open(tmp_path / "half").progress()] == [
        each for each, _ in measures[0]
    ]
    without = TASK.replace("    measures = ", "    others = ")
    cart.write_text(without)
    bare = learnt(small(cart), tmp_path / "bare", 1, cart)
    assert bare["parameters_sha256"] == one["parameters_sha256"], "measures change nothing"
    assert "robust_measures" not in bare


def test_they_are_in_the_line_of_a_generation_the_recording_and_the_evaluation(
    cart: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = [
        "--task",
        f"{cart}:Cart",
        "--policy",
        "linear",
        "--generations",
        "2",
        "--pairs",
        "3",
        "--workers",
        "1",
    ]
    assert main(["run", *flags, "--name", "r"]) == 0
    assert "  farthest 0.5  push 0  sigma" in capsys.readouterr().out
    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "runs/r/run.rrd").stream()}
    for name in ("farthest", "push"):
        assert {f"/learning/measures/{name}", f"/learning/mean_policy/measures/{name}"} <= entities
    assert main(["evaluate", "runs/r", "--rollouts", "5", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures["perturbed"]["measures"]) == ["farthest", "push"]
    summary = json.loads((tmp_path / "runs/r/summary.json").read_text())
    assert figures["nominal"]["measures"] == summary["mean_policy_measures"]


@pytest.mark.slow
def test_a_sweeps_table_has_them(
    cart: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = [
        "--task",
        f"{cart}:Cart",
        "--policy",
        "linear",
        "--generations",
        "1",
        "--pairs",
        "2",
        "--workers",
        "1",
    ]
    assert (
        main(
            [
                "sweep",
                *flags,
                "--vary",
                "initial-sigma=0.1,0.5",
                "--seeds",
                "0",
                "--out",
                "s",
            ]
        )
        == 0
    )
    with next((tmp_path / "s").rglob("table.csv")).open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert 0.29 < float(row["measure_farthest"]) < 2.0
        assert 0.0 <= float(row["measure_push"]) <= 1.0
    output = capsys.readouterr().out
    assert "farthest" in output
    assert "push" in output
