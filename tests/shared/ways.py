"""The ways that docs/architecture.md describes: of a perturbation and of a trace, function by
function.
"""

import re
from pathlib import Path
from typing import Final, NamedTuple

PAGE: Final = Path(__file__).parents[2] / "docs" / "architecture.md"


class Way(NamedTuple):
    """A table of the page."""

    stations: tuple[tuple[str, str], ...]
    """File and qualified name of each row's function or class, in order."""
    files: frozenset[str]
    """Every file that the table names."""


def way(of: str) -> Way:
    """The table under the heading "The way of ..."."""
    _, _, rest = PAGE.read_text("utf-8").partition(f"# The way of {of}\n")
    rows = [line for line in rest.partition("\n#")[0].splitlines() if re.match(r"\| \d+ \|", line)]
    pairs = [re.findall(r"`([\w/]+\.py):([\w.]+)`", row) for row in rows]
    return Way(
        tuple(each[0] for each in pairs), frozenset(file for each in pairs for file, _ in each)
    )
