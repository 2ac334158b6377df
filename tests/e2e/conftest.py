"""Fixtures of the integration tests."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from processes import SMALL, Farm


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
