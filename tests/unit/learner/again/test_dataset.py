"""A data set's parts, without a network: lies are found, and what an expelled host has simulated is made again."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from alone import POLE, Alone

from farm.errors import RunError
from farm.net.work import Jobs, Results
from farm.tasks.rollouts import steps_shape
from learner.again import dataset
from learner.again.dataset import DataSet, Work
from learner.again.replay import restored
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.scheduler.round import RoundResults

pytest.importorskip("pyarrow")
EPISODES = 7


class Hosts:
    """In place of a dispatcher: the host of each part, changes of its results, and the hosts expelled in each part."""

    def __init__(self, work: Work, change: Callable[[int, Any], Any], expelled: dict[int, str]) -> None:
        self._work, self._change, self._expelled = work, change, expelled
        self._runner = work.problem.runner()
        self.admission, self.parts = SimpleNamespace(expelled={}), list[int]()

    def begin(self, part: int, mu: np.ndarray, jobs: Jobs, traces: str, normaliser: np.ndarray, *, terms: bool) -> None:
        self.round = RoundResults(jobs, traces, self._work.problem.shapes(steps=True), terms=terms)
        simulated = self._runner.run(mu, jobs, traces, normaliser, terms=terms)
        results = self._change(
            part, Results.carrying(simulated, jobs, 0.0, run="r", incarnation="i", round=0, worker="w/1")
        )
        place = self.round.place(results)
        assert place is not None
        self.round.put(results, place, np.ones(len(jobs), bool))
        self.parts.append(part)
        self.hosts = [f"host-{part}"]

    def progress(self) -> Iterator[RoundResults]:
        yield self.round
        if (name := self._expelled.pop(self.parts[-1], None)) is not None:
            self.admission.expelled[name] = "it lied"

    def collect(self) -> RoundResults:
        return self.round

    def check_the_rest(self) -> bool:
        return False


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    (tmp_path / "pole.py").write_text(POLE)
    config = configure(f"{tmp_path / 'pole.py'}:Pole", generations=2, policy="linear")
    problem, at = setup.start(config, "r")
    learner = Learner(problem, RunFolder.create(tmp_path / "r", config), at)
    for _ in learner.learn(Alone(problem)):  # type: ignore[arg-type]
        pass
    return learner.folder


@pytest.fixture
def make(run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Work, Hosts]]:
    """Writes a data set of four parts."""

    def write(
        name: str, change: Callable[[int, Any], Any] = lambda _, results: results, **expelled: Any
    ) -> tuple[Work, Hosts]:
        of = DataSet(tmp_path / name, EPISODES, 1)
        assert not of.begin(run)
        at = checkpoints.load(run.checkpoint)
        problem = restored(run, at)
        monkeypatch.setattr(dataset, "PART", 2 * 4 * int(np.prod(steps_shape(problem.spec))))
        work = Work(of, problem, at, True)
        assert work.parts == 4
        hosts = Hosts(work, change, expelled.get("expelled", {}))
        for _ in work.learn(hosts):  # type: ignore[arg-type]
            pass
        return work, hosts

    return write


def shifted(part: int, results: Results) -> Results:
    """In the third part, one channel's values, and no number that a spot check compares."""
    if part == 2:
        results.traces[:, 1, -1] += 1e-3
    return results


def test_a_worker_that_changes_a_channel_is_found(make: Callable[..., tuple[Work, Hosts]], tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"episode [45] has other numbers here than a worker sent: of host-2 one lies"):
        make("a", shifted)
    assert len(list((tmp_path / "a/data/chunk-000").iterdir())) == 2, "the honest parts stay"


def test_what_an_expelled_host_has_simulated_is_made_again(make: Callable[..., tuple[Work, Hosts]]) -> None:
    honest, _ = make("a")
    work, hosts = make("b", expelled={3: "host-1"})
    assert hosts.parts == [0, 1, 2, 3, 1, 2, 3]
    assert [part["numbers"] for part in work.done] == [part["numbers"] for part in honest.done]
    assert work.expelled == {"host-1": "it lied"}
