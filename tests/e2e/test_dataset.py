"""Data sets: the same bytes for any number of workers, after kills and interruptions, and from the
manifest alone.
"""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from processes import Farm, children

import farm as package
from farm import seeds
from learner import parquet

pytestmark = pytest.mark.slow

WIDE = """
import numpy as np
import farm

class Wide(farm.Task):
    xml = '''<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="1"/>
        <geom size="0.1" mass="1"/></body>
      </worldbody><actuator><motor joint="j"/></actuator></mujoco>'''
    steps = 400
    channels = (
        farm.Channel(name="wide/lot", kind="scalars", shape=(900,)),
        farm.Channel(name="seen", kind="images", shape=(1, 2, 3), trace=True),
    )

    def reset(self, sim, row, rng):
        sim.qpos[row] = 0.0 if rng is None else rng.uniform(-0.5, 0.5)

    def reward(self, sim, action):
        return {"near": -np.abs(sim.qpos[:, 0]), "weak": -0.1 * action[:, 0] ** 2}

    def ended(self, sim):
        return sim.qpos[:, 0] > 0.45

    def success(self, sim):
        return sim.qpos[:, 0] < 0.3

    def measure(self, sim):
        seen = np.tile(sim.qpos[:, :, None, None], (1, 1, 2, 3))
        return {"wide/lot": np.tile(sim.qvel, 900), "seen": seen}
"""
"""Eleven episodes make a part."""
EPISODES = 60


@pytest.fixture
def run(farm: Farm) -> Farm:
    (farm.folder / "wide.py").write_text(WIDE)
    words = (
        "--generations",
        "2",
        "--pairs",
        "2",
        "--policy",
        "linear",
        "--normalise",
        "--no-record",
        "--name",
        "r",
    )
    farm.call("run", "--task", "wide.py:Wide", *words, "--quiet")
    return farm


def words_of(farm: Farm, out: str, *words: str) -> tuple[str, ...]:
    return ("dataset", "runs/r", "--episodes", str(EPISODES), "--out", out, *words)


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(each.relative_to(folder)): each.read_bytes()
        for each in folder.rglob("*")
        if each.is_file()
    }


def parts(folder: Path) -> int:
    path = folder / "unfinished.json"
    return len(json.loads(path.read_text())["done"]) if path.exists() else 0


def test_killed_workers_and_learners_change_no_byte(run: Farm) -> None:
    assert f"{EPISODES} episodes in a" in run.call(*words_of(run, "a", "--workers", "2"))
    whole = files(run.folder / "a")
    assert len([name for name in whole if name.startswith("data/")]) == 6
    making = run.start(*words_of(run, "b", "--workers", "2"))
    run.wait_for(lambda: parts(run.folder / "b") >= 1)
    os.kill(children(making.pid)[0], signal.SIGKILL)
    run.wait_for(lambda: parts(run.folder / "b") >= 2)
    making.kill()
    making.wait()
    assert "files" not in run.json("b/manifest.json")
    making = run.start(*words_of(run, "b", "--workers", "1"))
    run.wait_for(lambda: parts(run.folder / "b") >= 3)
    making.send_signal(signal.SIGINT)
    output, _ = making.communicate(timeout=60)
    assert (making.returncode, "the same command continues" in output) == (130, True)
    run.call(*words_of(run, "b", "--workers", "3"))
    assert files(run.folder / "b") == whole
    assert "is complete" in run.call(*words_of(run, "b"))
    # The manifest's folder has what is needed
    (run.folder / "runs").rename(run.folder / "elsewhere")
    output = run.call("dataset", "--from", "a/manifest.json", "--out", "c", "--workers", "1")
    assert "the same bytes as a/manifest.json says" in output
    assert files(run.folder / "c") == whole


def test_the_rows_are_those_of_the_policys_rollouts(run: Farm) -> None:
    run.call(*words_of(run, "a", "--workers", "2"))
    policy = package.load(run.folder / "runs/r")
    starts = [seeds.evaluation_start(1, i) for i in range(EPISODES)]
    rollouts = policy.runner.rollouts(np.repeat(policy.mu[None], EPISODES, axis=0), starts)
    data, about = run.folder / "a/data/chunk-000", run.folder / "a/meta/episodes/chunk-000"
    info, first = run.json("a/meta/info.json"), 0
    for path in sorted(data.iterdir()):
        episodes = parquet.read(
            about / path.name,
            ["episode_index", "length", "return", "success", "dataset_from_index"],
        )
        rows = parquet.read(path, list(info["features"]))
        for at, episode in enumerate(episodes["episode_index"]):
            steps = int(rollouts.steps[episode])
            assert (episodes["length"][at], episodes["dataset_from_index"][at]) == (steps, first)
            assert episodes["return"][at] == rollouts.returns[episode]
            assert episodes["success"][at] == rollouts.success[episode]
            row = episodes["dataset_from_index"][at] - episodes["dataset_from_index"][0]
            columns = {name: np.array(values[row : row + steps]) for name, values in rows.items()}
            start, qpos = rollouts.start["qpos"][episode], rollouts.frames["qpos"][episode, :steps]
            before = np.concatenate([start[None], qpos[:-1]])
            np.testing.assert_array_equal(
                columns["observation.state"][:, 0], before[:, 0].astype("<f4")
            )
            np.testing.assert_array_equal(
                columns["action"], rollouts.actions[episode, :steps, 0].astype("<f4")
            )
            terms = rollouts.terms[episode, :steps].astype("<f4")
            np.testing.assert_array_equal(columns["next.reward_terms"], terms)
            np.testing.assert_array_equal(
                columns["next.reward"], terms.sum(axis=1, dtype=float).astype("<f4")
            )
            assert columns["next.seen"].shape == (steps, 1, 2, 3)
            np.testing.assert_array_equal(
                columns["next.seen"][:, 0, 1, 2], qpos[:, 0].astype("<f4")
            )
            assert columns["next.wide.lot"].shape == (steps, 900)
            assert columns["next.done"].tolist() == [False] * (steps - 1) + [True]
            assert columns["index"].tolist() == list(range(first, first + steps))
            first += steps
    assert info["total_frames"] == first == rollouts.steps.sum()
    assert (rollouts.steps < 400).any()


def test_what_differs_from_a_manifest_is_said(run: Farm) -> None:
    run.call("dataset", "runs/r", "--episodes", "3", "--out", "a", "--workers", "1")
    assert "its episodes is 3, not 4" in run.call(
        "dataset", "runs/r", "--episodes", "4", "--out", "a", status=2
    )
    altered = run.json("a/manifest.json") | {"numbers_sha256": "0" * 64}
    altered["files"]["data/chunk-000/file-000.parquet"] = "0" * 64
    (run.folder / "a/manifest.json").write_text(json.dumps(altered))
    output = run.call(
        "dataset", "--from", "a/manifest.json", "--out", "b", "--workers", "1", status=1
    )
    assert (
        "b differs from a/manifest.json: data/chunk-000/file-000.parquet and 0 more files have"
        " other numbers" in output
    )
    run.call("dataset", "runs/r", "--episodes", "3", "--out", "d", "--workers", "1")
    (run.folder / "d/data/chunk-000/file-000.parquet").write_bytes(b"other")
    output = run.call("dataset", "--from", "d/manifest.json", "--out", "d", status=1)
    assert "d/data/chunk-000/file-000.parquet has other bytes, after d/manifest.json was" in output
    assert "expected the folder of a run, or --from" in run.call("dataset", "--out", "c", status=2)
    (run.folder / "runs/r/checkpoint").rename(run.folder / "checkpoint")
    output = run.call("dataset", "runs/r", "--episodes", "3", "--out", "e", status=2)
    assert "checkpoint" in output
    (run.folder / "checkpoint").rename(run.folder / "runs/r/checkpoint")
    (run.folder / "e/run.new").mkdir(parents=True)  # as a killed command leaves it
    run.call("dataset", "runs/r", "--episodes", "3", "--out", "e", "--workers", "1")
    assert sorted(path.name for path in (run.folder / "e").iterdir()) == sorted(
        path.name for path in (run.folder / "d").iterdir()
    )
    (run.folder / "full").mkdir()
    (run.folder / "full/mine.txt").write_text("")
    output = run.call("dataset", "runs/r", "--episodes", "3", "--out", "full", status=2)
    assert "full is not empty, and has no manifest.json" in output
