"""The command line: `farm COMMAND ...`.

Every command's help comes from its configuration dataclass.
"""

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from farm import __version__
from farm.errors import (
    ConfigError,
    FarmError,
    Interrupted,
    RunError,
    described,
    printable,
    short_of_memory,
)
from farm.processes import ONE_THREAD, default_signals_in_forks

if TYPE_CHECKING:
    from types import FrameType

_PIPE: Final = 141
"""Exit status if the reader of standard output went away, as in a shell: 128 and SIGPIPE."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; exit status 0, 1 for a failure, 2 for a mistake in its use."""
    standalone = arguments is None  # a process of its own
    try:
        if standalone:
            _signals(signal.SIG_DFL)  # during imports there is nothing to save or to stop yet
            _streams()
            default_signals_in_forks()
        status = _run(list(sys.argv[1:] if arguments is None else arguments), standalone=standalone)
        sys.stdout.flush()
    except (KeyboardInterrupt, SystemExit, Exception) as error:
        status = _ended(error)
    if standalone:
        _signals(signal.SIG_DFL)
    return status


def _run(words: Sequence[str], *, standalone: bool) -> int:
    name = words[0] if words else "--help"
    if name in ("-h", "--help", "--help-all", "help"):
        sys.stdout.write(_overview())
        return 0
    if name == "--version":
        sys.stdout.write(f"rolloutfarm {__version__}\n")
        return 0
    if name in ("run", "worker"):
        # Before numpy is imported: workers may be forks of this process
        os.environ.update(ONE_THREAD)
    from farm import flags, plugins

    if name in plugins.COMMANDS:
        words = flags.long(words)
        if standalone and words[1:] in ([each] for each in flags.HELP):
            # This help draws nothing: MuJoCo need not look how
            os.environ.setdefault("MUJOCO_GL", "disable")
    command = plugins.find("commands", name).target
    if standalone:
        # Unless a command decides otherwise, SIGTERM and SIGHUP act like Ctrl-C
        _signals(signal.default_int_handler)
    return int(command(words[1:]))


def _signals(handler: "Callable[[int, FrameType | None], Any] | signal.Handlers") -> None:
    """Handle Ctrl-C, SIGTERM and SIGHUP; signals that this process was told to ignore (as by
    nohup) stay ignored.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def _streams() -> None:
    """Make sure that no file takes the place of standard output or error if these are closed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # it takes the least number that is free
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)
        raise RunError("standard output is closed; > /dev/null discards it")


def _ended(error: BaseException) -> int:
    """Print how a command ended, and return its exit status; errors that are not the user's are
    raised again.
    """
    unwritten = _unwritten()
    if isinstance(error, BrokenPipeError) or isinstance(unwritten, BrokenPipeError):
        return _PIPE  # the reader has ended, such as head
    # An extension module that is interrupted while it is imported raises an ImportError from it
    if isinstance(error, ImportError) and isinstance(error.__cause__, KeyboardInterrupt):
        error = error.__cause__
    if isinstance(error, KeyboardInterrupt | Interrupted):
        text = "" if isinstance(error, Interrupted) else "farm: stopped before the end\n"
        status = 130
    elif isinstance(error, FarmError):
        text = f"farm: {printable(str(error))}\n"
        status = 2 if isinstance(error, ConfigError) else 1
    elif unwritten and isinstance(error, OSError):
        text, status = f"farm: cannot write to standard output: {unwritten.strerror}\n", 1
    else:
        # Not imported here: there may be no file left to open. The lines of a task of the user's
        # own help.
        plugins = sys.modules.get("farm.plugins")
        frames = plugins.author_frames(error).format() if plugins else []
        short = short_of_memory(error)
        if not frames and not short and not isinstance(error, OSError):
            raise error
        reason = _system(error) if isinstance(error, OSError) else described(error)
        if short:
            reason = short if isinstance(error, MemoryError) else f"{reason}; {short}"
        traced = printable("".join(frames), kept="\n")
        text, status = f"{traced}farm: {printable(reason)}\n", 1
    with suppress(OSError):
        sys.stderr.write(text)
    return status


def _unwritten() -> OSError | None:
    """Why standard output did not take what was written to it, or None; the rest is discarded."""
    try:
        sys.stdout.flush()
    except OSError as error:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error
    return None


def _system(error: OSError) -> str:
    """The system's error, and the remedy."""
    hints = {errno.EMFILE: "allow more of them: ulimit -n 1024", errno.ENOSPC: "make room"}
    try:
        Path.cwd()
    except OSError:
        hints[errno.ENOENT] = "the working folder is gone, change to another"
    words = (str(error.filename or ""), error.strerror or str(error) or type(error).__name__)
    hint = hints.get(error.errno or 0)
    return ": ".join(filter(None, words)) + (f"; {hint}" if hint else "")


def _overview() -> str:
    from farm import plugins

    origins = plugins.names("commands")
    installed = {name: origin for name, origin in origins.items() if name not in plugins.COMMANDS}
    groups = {**plugins.GROUPS, "of other packages": installed}
    parts = [
        f"{title}:\n" + "".join(f"  farm {name:<14}{text}\n" for name, text in group.items())
        for title, group in groups.items()
        if group
    ]
    return (
        "rolloutfarm: policy search on any MuJoCo task, with as many workers on as many machines"
        " as you like.\n\n" + "\n".join(parts) + "\nfarm COMMAND --help shows the usual flags of"
        " a command, --help-all all; farm --version prints the version.\n"
    )


if __name__ == "__main__":
    # `python -m farm` puts the current folder first in the path: nothing is imported from there.
    with suppress(FileNotFoundError):
        if not sys.flags.safe_path and sys.path and sys.path[0] in ("", str(Path.cwd())):
            del sys.path[0]
    sys.exit(main())
