"""The flag for files whose code may run although a run's folder only names them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from farm.settings import Settings


@dataclass(frozen=True, kw_only=True)
class AllowedFiles(Settings):
    """Files with classes of runs that somebody else made."""

    allow_file: tuple[Path, ...] = ()
    """Take the run's class in a file of this name from this file, repeatable; needed for runs
    that others made.
    """


def allowed(words: Sequence[str]) -> tuple[Path, ...]:
    """The files in a command's words: a run is read before they are parsed."""
    return tuple(map(Path, values_of(words, "--allow-file")))


def values_of(words: Sequence[str], flag: str) -> list[str]:
    """The values given for a flag, in either form."""
    values = []
    for i, word in enumerate(words):
        if word == flag and i + 1 < len(words):
            values.append(words[i + 1])
        elif word.startswith(flag + "="):
            values.append(word.partition("=")[2])
    return values
