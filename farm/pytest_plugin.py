"""The fixture `golden` and the flag --golden-update of pytest, for test suites of tasks.

It is loaded by pytest itself.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import pytest

Golden: TypeAlias = Callable[[Any, Any, Iterable[int | None], str], None]


def pytest_addoption(parser: pytest.Parser) -> None:
    """The flag."""
    group = parser.getgroup("rolloutfarm")
    group.addoption(
        "--golden-update", action="store_true", help="write the files of golden rollouts again"
    )


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Golden:
    """`farm.testing.same` with a file whose path begins in the test's folder."""
    from farm.testing import same  # imports MuJoCo, which most tests of an environment do not need

    def compare(task: Any, policy: Any, starts: Iterable[int | None], file: str) -> None:  # noqa: ANN401
        __tracebackhide__ = True
        same(
            task,
            policy,
            starts,
            request.path.parent / file,
            update=request.config.getoption("golden_update"),
        )

    return compare
