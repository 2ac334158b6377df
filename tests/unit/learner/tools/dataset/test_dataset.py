"""A data set's parts, without a network: lies are found, and what an expelled host has simulated is
made again.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from alone import POLE, Alone

from farm.__main__ import main
from farm.errors import ConfigError, RunError
from farm.net.work import Jobs, Results
from farm.tasks.rollouts import steps_shape
from learner.pool.round import RoundResults
from learner.run import checkpoint as checkpoints
from learner.run import setup
from learner.run.config import configure
from learner.run.folder import RunFolder
from learner.run.learner import Learner
from learner.tools.dataset import dataset
from learner.tools.dataset.dataset import DataSet, Work
from learner.tools.replay.loaded import restored

pytest.importorskip("pyarrow")
EPISODES = 7


class Hosts:
    """In place of a pool: the host of each part, changes of its results, and the hosts
    expelled in each part.
    """

    def __init__(
        self, work: Work, change: Callable[[int, Any], Any], expelled: dict[int, str]
    ) -> None:
        self._work, self._change, self._expelled = work, change, expelled
        self._runner = work.problem.runner()
        self.admission, self.parts = SimpleNamespace(expelled={}), list[int]()

    def begin(
        self,
        part: int,
        mu: np.ndarray,
        jobs: Jobs,
        traces: str,
        normaliser: np.ndarray,
        *,
        terms: bool,
    ) -> None:
        self.round = RoundResults(jobs, traces, self._work.problem.shapes(steps=True), terms=terms)
        simulated = self._runner.run(mu, jobs, traces, normaliser, terms=terms)
        results = self._change(
            part,
            Results.carrying(simulated, jobs, 0.0, run="r", incarnation="i", round=0, worker="w/1"),
        )
        place = self.round.place(results)
        assert place is not None
        self.round.put(results, place, np.ones(len(jobs), bool))
        self.parts.append(part)
        self.hosts = [f"host-{part}"]

    def progress(self, *, checked: bool = False) -> Iterator[RoundResults]:
        yield self.round
        if (name := self._expelled.pop(self.parts[-1], None)) is not None:
            self.admission.expelled[name] = "it lied"

    def collect(self) -> RoundResults:
        return self.round


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
def make(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[Work, Hosts]]:
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


def test_a_worker_that_changes_a_channel_is_found(
    make: Callable[..., tuple[Work, Hosts]], tmp_path: Path
) -> None:
    with pytest.raises(
        RunError,
        match=r"episode [45] has other numbers here than a worker sent: of host-2 one lies",
    ):
        make("a", shifted)
    assert len(list((tmp_path / "a/data/chunk-000").iterdir())) == 2, "the honest parts stay"


def test_what_an_expelled_host_has_simulated_is_made_again(
    make: Callable[..., tuple[Work, Hosts]],
) -> None:
    honest, _ = make("a")
    work, hosts = make("b", expelled={3: "host-1"})
    assert hosts.parts == [0, 1, 2, 3, 1, 2, 3]
    assert [part["numbers"] for part in work.done] == [part["numbers"] for part in honest.done]
    assert work.expelled == {"host-1": "it lied"}


MANIFEST = {
    "version": 1,
    "episodes": 2,
    "seed": 1,
    "files": {},
    "numbers_sha256": "x",
    "pyarrow": "1",
}


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"episodes": None}, "episodes is 'None'; expected a whole number from 1 to 10000000"),
        ({"episodes": 0}, "episodes is '0'"),
        ({"episodes": 1.5}, "episodes is '1.5'"),
        ({"episodes": True}, "episodes is 'True'"),
        ({"episodes": 10**15}, "episodes is '1000000000000000'"),
        ({"seed": [1]}, "seed is .*; expected a whole number from 0 to 4294967295"),
        ({"seed": -5}, "seed is '-5'"),
        ({"files": []}, r"files is '\[\]'; expected a table of digests by path"),
        ({"numbers_sha256": 3}, "numbers_sha256 is '3'; expected a text"),
        ({"pyarrow": None}, "pyarrow is 'None'; expected a text"),
        ({"version": 2}, "is not of version 1"),
        ({"version": None}, "is not of version 1"),
    ],
)
def test_made_up_manifests_are_refused_before_anything_is_done(
    tmp_path: Path, changed: dict[str, object], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps(MANIFEST | changed))
    with pytest.raises(ConfigError, match=reason):
        dataset.read(path)
    assert main(["dataset", "--from", str(path), "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    assert "manifest.json" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["[]", "7", "no JSON", "[" * 100_000, "9" * 10_000, ""])
def test_manifests_that_are_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ConfigError, match="is not JSON|is not of version 1"):
        dataset.read(tmp_path / "manifest.json")


def test_a_manifest_that_is_very_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "manifest.json"
    with path.open("wb") as file:
        file.truncate(1 << 30)  # takes no room
    with pytest.raises(ConfigError, match="has 1024 MiB; at most 64 are read"):
        dataset.read(path)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"done": 3, "expelled": {}}',
        '{"done": [{}], "expelled": {}}',
        '{"done": [], "expelled": []}',
    ],
)
def test_a_made_up_account_of_parts(tmp_path: Path, text: str) -> None:
    (tmp_path / "unfinished.json").write_text(text)
    with pytest.raises(ConfigError, match="unfinished.json is damaged"):
        dataset._unfinished(tmp_path / "unfinished.json")
