"""A learner and workers without physics."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from doubles import FARM, WAIT, Hire, Learner, Worker

from farm.net.session import connect, free_endpoint, listen


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def learner(endpoint: str) -> Iterator[Learner]:
    with listen(endpoint, FARM) as session:
        started = Learner(session)
        yield started
        started.close()


@pytest.fixture
def hire(endpoint: str, learner: Learner) -> Iterator[Hire]:
    with ExitStack() as stack:
        yield lambda name, kind=Worker: kind(
            stack.enter_context(connect((endpoint,), WAIT, lambda: False)), name
        )
