"""A task that hangs in a local worker: a line says so, the worker is replaced, and the numbers stay
the same.
"""

import gc
import logging
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from forked import returns, tried
from made import pole

import farm
from farm.errors import RunError
from learner.pool import workforce
from learner.run.folder import RunFolder

HANGS = """
    def reward(self, sim, action):
        import os, time
        for path in {paths}:
            try:
                os.unlink(path)
            except FileNotFoundError:
                continue
            time.sleep(1e6)
        return super().reward(sim, action)
"""


@pytest.fixture
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less than a user's run does."""
    for name, seconds in {"LINE": 1.0, "END": 2.0, "_FIRST_LINE": 5.0, "_FIRST_END": 8.0}.items():
        monkeypatch.setattr(workforce, name, seconds)


def hanging(folder: Path, count: int) -> str:
    """A task that hangs `count` times: whenever it finds one of these files, which it removes."""
    paths = [str(folder / f"hang-{number}") for number in range(count)]
    source = pole(folder).read_text()
    (folder / "hangs.py").write_text(f"{source}\n\nclass Hangs(Pole):{HANGS.format(paths=paths)}")
    return f"{folder / 'hangs.py'}:Hangs"


def learnt(task: str, path: Path, begin: int, paths: list[Path], **settings: int) -> bytes:
    config = farm.configure(task, generations=6, pairs=3, **settings)
    for report in farm.learn(config, path, workers=2):
        if report.progress.generation == begin:
            for each in paths:
                each.touch()
    return RunFolder.open(path).chain.path.read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("_soon")
def test_a_worker_that_hangs_is_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    task, paths = hanging(tmp_path, 2), [tmp_path / "hang-0", tmp_path / "hang-1"]
    calm = learnt(task, tmp_path / "calm", 0, [])
    with caplog.at_level(logging.WARNING):
        assert learnt(task, tmp_path / "run", 2, paths) == calm
    assert "s, at job " in caplog.text
    assert ": does its task hang?" in caplog.text
    assert ": it is replaced" in caplog.text
    assert "ended with status -9; starting another" in caplog.text


@pytest.mark.slow
@pytest.mark.usefixtures("_soon")
def test_a_task_that_always_hangs_ends_the_run(tmp_path: Path) -> None:
    task, paths = hanging(tmp_path, 20), [tmp_path / f"hang-{number}" for number in range(20)]
    with pytest.raises(
        RunError, match="4 workers had to be replaced because they did not answer, the last after"
    ):
        learnt(task, tmp_path / "run", 2, paths)
    assert RunFolder.open(tmp_path / "run").progress()[-1].generation >= 2, (
        "what was learnt is saved"
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_child_of_a_program_that_has_used_a_farm(method: str) -> None:
    before = returns()
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=tried, args=(queue, None))
    process.start()
    answer = queue.get(timeout=60)
    process.join()
    assert (
        "forked from one that has used a farm" in str(answer)
        if method == "fork"
        else answer == before
    )


@pytest.mark.slow
def test_a_fork_collects_no_garbage_of_the_program_it_comes_from() -> None:
    gc.disable()  # so that what is left of the session is still there
    try:
        returns()
        process = multiprocessing.get_context("fork").Process(target=gc.collect)
        process.start()
    finally:
        gc.enable()
    process.join(30)
    ended = process.exitcode == 0
    process.kill()
    assert ended


@pytest.mark.slow
def test_a_pool_in_a_fork_says_so_and_leaves_the_parents_workers_alone() -> None:
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    with farm.Farm("finger-gait", policy="constant", workers=1) as pool:
        process = context.Process(target=tried, args=(queue, pool))
        process.start()
        assert "was opened before this process was forked" in str(queue.get(timeout=60))
        process.join()
        assert len(pool.map(np.zeros((2, pool.size)))) == 2
