"""A robot in files: learnt by workers that have none of them, resumed, replayed, rewound and
recorded.
"""

import errno
import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning import learnt
from robot import robot, stl

from farm.errors import CheckpointError, UnservedError
from farm.net.session import connect, free_endpoint, listen
from farm.sim.model_files import digest
from learner.farm import Farm
from learner.pool.placement import Placement
from learner.run.config import RunConfig, configure
from learner.run.folder import RunFolder
from learner.run.launch import open_run
from learner.telemetry.subscriber import Subscriber
from learner.tools.replay.loaded import load
from learner.tools.replay.rewind import rewind
from workers import source_cache
from workers.source_cache import SourceCache


@pytest.fixture
def task(tmp_path: Path) -> Path:
    return robot(tmp_path / "mine")


@pytest.fixture
def copy(task: Path, tmp_path: Path) -> Path:
    """The class alone, in a folder without the robot: what a worker's user has allowed."""
    return Path(shutil.copy(task, tmp_path))


def small(task: Path, **more: Any) -> RunConfig:
    values: dict[str, Any] = {
        "generations": 4,
        "pairs": 4,
        "policy": "linear",
        "initial_sigma": 0.5,
    }
    return configure(f"{task}:Reach", **(values | more))


@pytest.mark.slow
def test_workers_without_the_robot_learn_it_and_the_run_keeps_it(
    task: Path, copy: Path, tmp_path: Path
) -> None:
    config = small(task)
    one, two = (learnt(config, tmp_path / str(count), count, copy) for count in (1, 2))
    assert one["state"] == two["state"] == "finished"
    assert one["parameters_sha256"] == two["parameters_sha256"]
    assert len(list((tmp_path / "1/assets").iterdir())) == 3, (
        "mesh, texture, height field: once each"
    )
    learnt(small(task, generations=2), tmp_path / "half", 1, copy)
    (task.parent / "robot/assets/link.stl").write_bytes(stl(0.2))
    other = learnt(config, tmp_path / "other", 1, copy)
    assert other["parameters_sha256"] != one["parameters_sha256"], "a mesh decides numbers"
    shutil.rmtree(task.parent / "robot")
    assert (
        learnt(config, tmp_path / "half", 1, copy, resume=True)["parameters_sha256"]
        == one["parameters_sha256"]
    )
    assert load(tmp_path / "1").rollout().trajectory.value == one["mean_policy_return"]
    replay = load(tmp_path / "1").rollout()
    ball = replay.trajectory.bodies[:, -1, :3]
    np.testing.assert_allclose(
        ball[::5, 2][1:], 0.3 + 0.01 * np.arange(20), rtol=1e-6, err_msg="a moving goal is drawn"
    )
    np.testing.assert_array_equal(
        replay.frames["mocap"][1:, 0, 2], np.repeat(0.3 + 0.01 * np.arange(20), 5)
    )
    assert load(tmp_path / "1", generation=0).problem.task.model.nmesh == 1
    for stats in RunFolder.open(tmp_path / "1").progress():
        assert rewind(tmp_path / "1", stats.generation).returns.max() == stats.return_max


def test_a_damaged_file_of_a_run_is_named(task: Path, copy: Path, tmp_path: Path) -> None:
    learnt(small(task, generations=1), tmp_path / "r", 1, copy)
    first = min((tmp_path / "r/assets").iterdir())
    first.write_bytes(b"something else")
    with pytest.raises(
        CheckpointError,
        match=rf"^{first}, the run's robot/assets/.*, is missing or damaged: put the",
    ):
        load(tmp_path / "r")


def test_a_recorder_gets_the_files(task: Path, copy: Path, tmp_path: Path) -> None:
    place = Placement(connect=(free_endpoint(),))
    with (
        listen(place.connect[0], "farm"),
        open_run(small(task), tmp_path / "r", place) as run,
        connect(place.connect, 20, lambda: False) as link,
    ):
        shutil.rmtree(task.parent / "robot")
        _, _, files = Subscriber(link, "farm", "r", (copy,)).begin(lambda: False)
        assert dict(files) == dict(run.learner.problem.task.sources)
        assert isinstance(files["robot/assets/link.stl"], bytes)


@pytest.mark.slow
def test_a_pool_has_the_robot(task: Path) -> None:
    with Farm(f"{task}:Reach", policy="linear", workers=1) as pool:
        returns = pool.map(np.zeros((2, pool.size)), seeds=[0, 1])
    assert (returns < 0.0).all()


def test_a_worker_keeps_what_it_was_sent_within_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    cache, content = SourceCache(), stl()
    try:
        with pytest.raises(UnservedError, match="does not match its digest"):
            cache.keep_asset(digest(content), content[:-1] + b"x")
        cache.keep_asset(digest(content), content)
        assert (cache.assets / digest(content)).read_bytes() == content
        monkeypatch.setattr(source_cache, "_ASSETS", 1000)
        with pytest.raises(UnservedError, match="takes no more"):
            cache.keep_asset(digest(content * 2), content * 2)
        monkeypatch.setattr(source_cache, "FILE_LIMIT", 500)
        with pytest.raises(UnservedError, match="too large"):
            cache.keep_asset(digest(content), content)
    finally:
        cache.close()


def test_a_worker_keeps_nothing_of_what_it_has_no_room_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cache, content = SourceCache(), stl()
    source = b"class Mine: pass\n"

    def half(path: Path, content: bytes) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    try:
        with monkeypatch.context() as full:
            full.setattr(Path, "write_bytes", half)
            with pytest.raises(UnservedError, match="received file: No space left on device"):
                cache.keep_asset(digest(content), content)
            with pytest.raises(UnservedError, match="make room"):
                cache.keep("mine.py", hashlib.sha256(source).hexdigest(), source)
        assert not list(cache.assets.iterdir())
        assert not cache.place("mine.py", hashlib.sha256(source).hexdigest()).exists()
    finally:
        cache.close()
