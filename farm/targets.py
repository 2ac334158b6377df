"""Whether a file or a folder can be made where a user wants it, said before any work."""

import shlex
from pathlib import Path

from farm.errors import ConfigError


def typed(path: Path | str) -> str:
    """A path as it is typed in a command."""
    return shlex.quote(str(path))


def check_target(flag: str, path: Path, *, folder: bool = False) -> None:
    """Check before any work that a file, or a folder, can be made at a path, as far as one sees.

    Raises:
      ConfigError: names the flag; something of the other kind is there, or a parent is a file.
    """
    parent = next((each for each in path.absolute().parents if each.exists()), None)
    if path.exists() and path.is_dir() != folder:
        what = "it is a file" if folder else "it is a folder"
    elif parent is not None and not parent.is_dir():
        what = f"{parent} is a file"
    else:
        return
    raise ConfigError(f"{flag} {path}: {what}; give another name")
