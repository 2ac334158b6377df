"""Certificates of hosts, and a small run that they may all work for."""

from pathlib import Path

import pytest
from hosts import HOSTS, file_of, finished, host, placed
from made import pole

from farm.commands import certificates
from learner.run.config import RunConfig, configure
from learner.run.launch import open_run


@pytest.fixture(scope="session")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates") / "own"
    workers = [word for name in HOSTS for word in ("--worker", name)]
    words = ["new", str(folder), "--learner", "127.0.0.1", *workers, "--viewer", "looker"]
    certificates.main(words)
    return folder


@pytest.fixture(scope="session")
def config(tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    file = pole(tmp_path_factory.mktemp("task") / "mine")
    return configure(f"{file}:Pole", generations=6, pairs=6, initial_sigma=0.5, validate=False)


@pytest.fixture(scope="session")
def honest(certs: Path, config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the run by one honest host."""
    place, folder = placed(certs), tmp_path_factory.mktemp("honest")
    with (
        open_run(config, folder / "honest", place) as run,
        host(place.listen, certs, "a", file_of(config)),
    ):
        return finished(run)
