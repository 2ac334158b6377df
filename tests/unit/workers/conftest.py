"""A test stage with a real session on loopback."""

import threading
from collections.abc import Iterator

import pytest
from stage import FARM, Runner, Stage, served

from farm import building
from farm.net.session import free_endpoint, listen


@pytest.fixture
def real() -> Iterator[Stage]:
    """Whose workers simulate."""
    Runner.go, Runner.builds, Runner.ran = threading.Event(), [], []
    Runner.go.set()
    endpoint = free_endpoint()
    with listen(endpoint, FARM) as session:
        opened = Stage(session, endpoint)
        yield opened
        opened.close()


@pytest.fixture
def stage(real: Stage, monkeypatch: pytest.MonkeyPatch) -> Stage:
    monkeypatch.setattr(building, "served", served)
    monkeypatch.setattr(building, "Runner", Runner)
    return real
