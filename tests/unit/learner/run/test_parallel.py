"""Several processes give the numbers of one, whatever happens to them."""

import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from farm import seeds
from farm.errors import FarmError, Interrupted
from farm.net.work import Jobs, Simulated
from learner.run import parallel
from learner.run.config import configure
from learner.run.parallel import ParallelRunner
from learner.run.setup import Problem, problem

NORMALISER = np.array([[[0.1, -0.1], [2.0, 0.5]]] * 2)


@pytest.fixture
def search(pole: str) -> Problem:
    return problem(configure(pole, policy="linear"))


@pytest.fixture
def jobs(search: Problem) -> Jobs:
    starts = [seeds.validation(1, i) for i in range(30)]
    eps = np.random.default_rng(2).standard_normal((30, search.policy.size))
    return Jobs.joined([Jobs.exploring(eps, (1, -1), starts), Jobs.mean("none", starts)])


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes are started however little there is to do."""
    monkeypatch.setattr(parallel, "BEGINNING", 0.0)


@pytest.fixture
def mu(search: Problem) -> np.ndarray:
    return np.random.default_rng(3).standard_normal(search.policy.size)


@pytest.fixture
def alike(search: Problem, mu: np.ndarray, jobs: Jobs) -> Callable[[ParallelRunner], bool]:
    """Whether a runner gives the numbers that `Runner` gives."""
    with closing(search.runner()) as runner:
        expected = runner.run(mu, jobs, "none", NORMALISER)
    return lambda several: equal(several.run(mu, jobs, NORMALISER), expected)


def equal(one: Simulated, other: Simulated) -> bool:
    names = ("returns", "flags", "steps", "traces", "moments", "measures", "terms")
    return all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes()
        and getattr(one, name).shape == getattr(other, name).shape
        for name in names
    )


def there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.usefixtures("at_once")
def test_several_processes_give_the_numbers_of_one(
    search: Problem, alike: Callable[[ParallelRunner], bool]
) -> None:
    for processes in (2, 3):
        with closing(ParallelRunner(search, processes)) as runner:
            for _ in range(2):
                assert alike(runner)
            pids = runner.pids
            assert len(pids) == processes
            assert all(map(there, pids))
        assert not any(map(there, pids)), "they end with it"


def test_none_is_started_for_little(
    search: Problem, alike: Callable[[ParallelRunner], bool]
) -> None:
    with closing(ParallelRunner(search, 64)) as runner:
        assert alike(runner)
        assert runner.pids == []


@pytest.mark.usefixtures("at_once")
def test_processes_that_die_or_cannot_begin_cost_only_time(
    search: Problem, alike: Callable[[ParallelRunner], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(ParallelRunner(search, 2)) as runner:
        assert alike(runner)
        for pid in runner.pids:
            os.kill(pid, signal.SIGKILL)
        assert alike(runner)

    for error in (FarmError("not here"), OSError("no memory"), RuntimeError("no thread")):

        class Refused:
            reason = error

            def __init__(self, *_: object) -> None:
                raise self.reason

        monkeypatch.setattr(parallel, "SubprocessRunner", Refused)
        with closing(ParallelRunner(search, 2)) as runner:
            assert alike(runner)
            assert runner.pids == []


@pytest.mark.usefixtures("at_once")
def test_a_machine_that_allows_no_more_processes_needs_none(
    search: Problem, alike: Callable[[ParallelRunner], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refused)
    with closing(ParallelRunner(search, 2)) as runner:
        assert alike(runner)
        assert runner.pids == []


@pytest.mark.usefixtures("at_once")
def test_it_stops_between_parts(search: Problem, mu: np.ndarray, jobs: Jobs) -> None:
    asked: list[bool] = []
    with closing(ParallelRunner(search, 2, lambda: bool(asked))) as runner:
        runner.run(mu, jobs, NORMALISER)
        asked.append(True)
        with pytest.raises(Interrupted):
            runner.run(mu, jobs, NORMALISER)


def test_one_process_looks_whether_to_stop_meanwhile(
    search: Problem, mu: np.ndarray, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "TURN", 0.0)
    asked: list[int] = []

    def stopped() -> bool:
        asked.append(1)
        return len(asked) > 5

    with closing(ParallelRunner(search, 1, stopped)) as runner, pytest.raises(Interrupted):
        runner.run(mu, jobs, NORMALISER)
    assert len(asked) == 6


def test_however_jobs_are_cut_the_numbers_are_the_same(
    search: Problem, alike: Callable[[ParallelRunner], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    for turn in (0.0, 1e-3, 1e3):
        monkeypatch.setattr(parallel, "TURN", turn)
        with closing(ParallelRunner(search, 1)) as runner:
            assert alike(runner)


@pytest.mark.usefixtures("at_once")
def test_binary_files_of_a_model_reach_them(tmp_path: Path) -> None:
    (tmp_path / "square.stl").write_bytes(_tetrahedron())
    path = tmp_path / "meshed.py"
    path.write_text(MESHED)
    search = problem(configure(f"{path}:Meshed", policy="constant"))
    jobs = Jobs.mean("none", [None] * 12)
    with closing(ParallelRunner(search, 2)) as runner, closing(search.runner()) as alone:
        assert equal(runner.run(np.ones(1), jobs), alone.run(np.ones(1), jobs))
        assert len(runner.pids) == 2


def _tetrahedron() -> bytes:
    """A solid in binary STL: a header, the number of triangles, and each one's normal and
    corners.
    """
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = b"".join(
        np.zeros(3, "<f4").tobytes() + corners[list(face)].tobytes() + b"\0\0" for face in faces
    )
    return bytes(80) + np.array([len(faces)], "<u4").tobytes() + triangles


MESHED = '''
from pathlib import Path
from farm import Task

class Meshed(Task):
    xml = """<mujoco><asset><mesh name="m" file="square.stl"/></asset><worldbody><body>
      <joint name="x" type="slide"/><geom type="mesh" mesh="m"/></body></worldbody>
      <actuator><motor joint="x"/></actuator></mujoco>"""
    steps = 3

    def files(self):
        solid = Path(__file__).with_name("square.stl").read_bytes()
        return {**super().files(), "square.stl": solid}

    def reward(self, sim, action):
        return -abs(sim.qpos[:, 0])
'''
