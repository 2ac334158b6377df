"""Fixtures of the integration tests."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from finished import GENERATIONS, Say
from processes import SMALL, Farm

from farm.__main__ import main


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    started = Farm(tmp_path)
    yield started
    started.close()


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The summary of an undisturbed small run of ten generations with two workers."""
    started = Farm(tmp_path_factory.mktemp("reference"))
    started.call("run", "--name", "r", "--generations", "10", *SMALL)
    return started.summary("r")


@pytest.fixture(scope="session")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Farm]:
    """Two small runs, one of them without a recording and with another controller; tests leave
    both as they are.
    """
    started = Farm(tmp_path_factory.mktemp("done"))
    started.call("run", "--name", "a", "--pairs", "4", "--generations", str(GENERATIONS))
    few = ("--pairs", "3", "--generations", "3", "--no-record")
    started.call(
        "run", "--name", "b", "--preset", "thesis", "--features", "60", "--seed", "5", *few
    )
    yield started
    started.close()


@pytest.fixture
def say(done: Farm, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Say:
    """What a command says, run in the folder of the runs; in this process, which has imported
    everything.
    """
    monkeypatch.chdir(done.folder)

    def call(*words: str, status: int = 0) -> str:
        assert main(words) == status
        output = capsys.readouterr()
        return output.out + output.err

    return call
