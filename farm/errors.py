"""The errors, as a tree.

FarmError                 anything that can be explained in one line
  ConfigError             a setting, flag or file the user gave makes no sense (exit status 2)
    CheckpointError       a run folder that cannot be continued or read
    UnservedError         a run that this machine's workers do not know, cannot or may not serve
  MessageError            bytes from the network that are no valid message
  TaskError               a task, policy, algorithm or engine with invalid results (exit status 1)
    UnstableError         physics that cannot go on
  RunError                a run that cannot continue (exit status 1)
  Interrupted             the user ended it before there was anything to save (exit status 130)
"""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_LINE: Final = 500  # characters
_ADDRESSES: Final = "ulimit -v unlimited; systemd's MemoryMax or a container limits memory itself"


def brief(text: str) -> str:
    """One printable line of at most 500 characters, from any text: for logs, and for messages to
    other machines.
    """
    line = " ".join(text[: 2 * _LINE].split())[:_LINE]
    return "".join(letter if letter.isprintable() else "?" for letter in line)


def printable(text: str, kept: str = "") -> str:
    r"""The text with invisible characters escaped, as \x1b: any machine may have sent it, and
    terminals obey it.

    Letters of all languages are kept, and so are the characters in `kept`.
    """
    return "".join(
        (
            letter
            if letter.isprintable() or letter in kept
            else letter.encode("unicode_escape").decode()
        )
        for letter in text
    )


def described(error: BaseException) -> str:
    """The type of an error and its text, which may be none, or one that cannot be made."""
    try:
        text = str(error)
    except BaseException as another:
        text = f"its text cannot be made: {type(another).__name__}"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def short_of_memory(error: BaseException) -> str:
    """What to do about an error that a low limit of memory causes; nothing if it is another one."""
    threads = isinstance(error, RuntimeError) and "can't start new thread" in str(error)
    library = isinstance(error, ImportError) and "failed to map segment" in str(error)
    system = isinstance(error, OSError) and error.errno == errno.ENOMEM
    if not (threads or library or system or isinstance(error, MemoryError)):
        return ""
    limit = address_limit()
    if limit is None:
        return "there is not enough memory"
    return f"ulimit -v {limit >> 10} leaves too few addresses: {_ADDRESSES}"


def address_limit() -> int | None:
    """Limit of this process's addresses, `ulimit -v` [bytes]; None without one."""
    try:
        import resource
    except ImportError:  # not everywhere
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def check_addresses(least: int, what: str, remedy: str = "") -> None:
    """Check that this process may use so many addresses [bytes]: some libraries end the program if
    it may not.

    Raises:
      ConfigError: it may not.
    """
    limit = address_limit()
    if limit is not None and limit < least:
        text = (
            f"ulimit -v {limit >> 10} is too low for {what}, which reserves {least >> 30} GiB of"
            " addresses"
        )
        raise ConfigError(f"{text}: {_ADDRESSES}{remedy}")


class FarmError(Exception):
    """One clear line: what was wrong, what was expected, what to do.

    Example:
      ```python
      import farm

      try:
          farm.configure("finger-gait", friction=-1.0)
      except farm.FarmError as error:  # a ConfigError
          print(error)
      ```
    """

    traceback: tuple[str, ...] = ()
    """The traceback of an error in code that ran in another process, in printable lines for its
    author.
    """


class ConfigError(FarmError):
    """A setting that makes no sense."""


class MessageError(FarmError):
    """A message that is malformed, oversized, or of another version."""

    def __init__(self, text: str, kind: str = "bad") -> None:
        super().__init__(text)
        self.kind = kind


class NameTakenError(ConfigError):
    """A new run's name is another run's: its folder exists, or a learner on the farm has it."""


class CheckpointError(ConfigError):
    """A run folder that cannot be continued or read."""


class UnservedError(ConfigError):
    """A run that this machine's workers do not know, lack something for, or may not serve; other
    workers may.
    """


class TaskError(FarmError):
    """A task, policy, algorithm or engine with invalid results: names the result, its value and
    what was expected.
    """


class UnstableError(TaskError):
    """Physics that cannot go on, from its start or by an error of MuJoCo's."""


class RunError(FarmError):
    """A run that cannot continue; what was learnt so far is saved."""


class Interrupted(FarmError):  # noqa: N818  not an error
    """The user ended it before there was anything to save."""


@contextmanager
def writing(what: object, kind: type[FarmError] = RunError) -> Iterator[None]:
    """Convert an error of the file system to one line that names what could not be written."""
    try:
        yield
    except OSError as error:
        raise kind(f"cannot write {what}: {error.strerror or error}") from None
