"""Files that are written whole, or left as they were."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a file beside `path`, with the same suffix, which takes its place at the end of the
    block; after an error in the block an existing file stays, and nothing is left beside it.
    """
    aside = path.with_name(f".{path.stem}.new{path.suffix}")  # hidden, as no user's file is
    aside.unlink(missing_ok=True)  # of a killed process
    try:
        yield aside
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
