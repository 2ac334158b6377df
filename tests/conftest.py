"""Options of the test suite."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--measurements", help="append what the tests measure to this file, rows of Markdown tables")
