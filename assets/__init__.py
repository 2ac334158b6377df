"""The hand, the objects and where they are."""

from importlib.resources import files
from pathlib import Path


def path(name: str) -> Path:
    """The file of that name in this package."""
    return Path(str(files("assets"))) / name


def objects() -> list[str]:
    """Names of the objects there are, one file each."""
    return sorted(file.stem for file in path("objects").glob("*.xml"))
