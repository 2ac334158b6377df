"""What can go wrong, as a tree.

FarmError                 anything we can say in one line
  ConfigError             a setting, flag or file the user gave makes no sense (exit status 2)
    CheckpointError       a run folder that cannot be continued or read
    UnservedError         a run that this machine's workers do not know, lack something for, or may not serve
  MessageError            bytes from the network that are not what they should be
  TaskError               a task or policy of the user's that gives arrays which make no sense (exit status 1)
  RunError                a run that cannot go on (exit status 1)
  Interrupted             the user ended it before there was anything to save (exit status 130)
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_LINE: Final = 500  # characters


def brief(text: str) -> str:
    """One printable line of at most 500 characters, of whatever text: for logs, and for what others are told."""
    line = " ".join(text[: 2 * _LINE].split())[:_LINE]
    return "".join(letter if letter.isprintable() else "?" for letter in line)


def printable(text: str, kept: str = "") -> str:
    r"""The text with whatever is not to be seen escaped, as \x1b: it may come from anybody, and terminals obey it.

    Letters of all languages stay; characters in `kept` do as well.
    """
    return "".join(
        letter if letter.isprintable() or letter in kept else letter.encode("unicode_escape").decode()
        for letter in text
    )


class FarmError(Exception):
    """One clear line: what was wrong, what was expected, what to do."""

    traceback: tuple[str, ...] = ()
    """Of an error in code that ran in another process: what its author wants to see, in printable lines."""


class ConfigError(FarmError):
    """A setting that makes no sense."""


class MessageError(FarmError):
    """A message that is malformed, oversized, or of another version."""

    def __init__(self, text: str, kind: str = "bad") -> None:
        super().__init__(text)
        self.kind = kind


class CheckpointError(ConfigError):
    """A run folder that cannot be continued or read."""


class UnservedError(ConfigError):
    """A run that this machine's workers do not know, lack something for, or may not serve; others may."""


class TaskError(FarmError):
    """A task or policy whose arrays make no sense: names the array, what came and what was expected."""


class RunError(FarmError):
    """A run that cannot go on; what was learnt so far is saved."""


class Interrupted(FarmError):  # noqa: N818  not an error
    """The user ended it before there was anything to save."""


@contextmanager
def writing(what: object, kind: type[FarmError] = RunError) -> Iterator[None]:
    """Have an error of the file system say in one line what could not be written."""
    try:
        yield
    except OSError as error:
        raise kind(f"cannot write {what}: {error.strerror or error}") from None
