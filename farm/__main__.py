"""The front door: `farm COMMAND ...`. Every command's help comes from its configuration dataclass."""

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from farm import __version__
from farm.errors import ConfigError, FarmError, Interrupted, RunError, printable

if TYPE_CHECKING:
    from types import FrameType

_PIPE: Final = 141
"""Exit status when whoever read standard output went away, as of a shell: 128 and SIGPIPE."""

COMMANDS: Final = {
    "run": "learner and local workers together: learns a task and records it",
    "learner": "the learner alone; workers join it from anywhere",
    "worker": "workers alone; they serve whichever learners are there",
    "tasks": "tasks, policies, algorithms and backends: what there is, from where, with its settings",
    "new-task": "writes a task of your own to start from, 30 lines that run",
    "check": "checks a task of your own: sizes, same bits however batched, rollouts per second, a picture",
    "evaluate": "the learnt mean policy on perturbed starts",
    "replay": "any policy of a run again, at physics rate, into a recording or a video",
    "chain": "learnt policies in turn, each from where the one before it ended",
    "compare": "several runs in one recording: curves overlaid, scenes side by side",
    "play": "the learnt policy in MuJoCo's interactive viewer: push what moves",
    "export": "the learnt policy as one file for plain MuJoCo and numpy",
    "sweep": "settings x seeds on one set of workers; a table and a figure",
    "record": "a run's recording made on any machine, over the network",
    "view": "opens the recordings of runs in the Rerun viewer",
    "runs": "a table of the runs in a folder",
    "status": "which runs and workers a farm has, and how they are doing",
    "router": "a permanent router that learners and workers connect to",
    "certificates": "a small certificate authority, for farms of several machines",
}
"""What the built-in commands are for."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; exit status 0, 1 for a failure, 2 for a mistake in its use."""
    own = arguments is None  # a process of its own
    try:
        if own:
            _signals(signal.SIG_DFL)  # among imports there is nothing to be ended in order yet
            _streams()
        status = _run(list(sys.argv[1:] if arguments is None else arguments), own=own)
        sys.stdout.flush()
    except (KeyboardInterrupt, Exception) as error:
        status = _ended(error)
    if own:
        _signals(signal.SIG_DFL)
    return status


def _run(words: Sequence[str], *, own: bool) -> int:
    name = words[0] if words else "--help"
    if name in ("-h", "--help", "help"):
        sys.stdout.write(_overview())
        return 0
    if name == "--version":
        sys.stdout.write(f"rolloutfarm {__version__}\n")
        return 0
    from farm import plugins

    command = plugins.find("commands", name).target
    if own:
        _signals(signal.default_int_handler)  # where a command has no better idea, SIGTERM is as Ctrl-C
    return int(command(words[1:]))


def _signals(handler: "Callable[[int, FrameType | None], Any] | signal.Handlers") -> None:
    """Handle Ctrl-C and SIGTERM; what this process was told to ignore (nohup, a job of a script) stays ignored."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def _streams() -> None:
    """See that no file of ours becomes standard output or error because that is closed."""
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
    """Say how a command ended, and return its exit status; what is no user's mistake is raised again."""
    unwritten = _unwritten()
    if isinstance(error, BrokenPipeError) or isinstance(unwritten, BrokenPipeError):
        return _PIPE  # whoever read had enough, as head does
    if isinstance(error, KeyboardInterrupt | Interrupted):
        said, status = "" if isinstance(error, Interrupted) else "farm: stopped before the end\n", 130
    elif isinstance(error, FarmError):
        said, status = f"farm: {printable(str(error))}\n", 2 if isinstance(error, ConfigError) else 1
    elif unwritten and isinstance(error, OSError):
        said, status = f"farm: cannot write to standard output: {unwritten.strerror}\n", 1
    else:
        plugins = sys.modules.get("farm.plugins")  # not imported here: there may be no file left to open
        frames = plugins.author_frames(error) if plugins else []  # of a task of the user's own, whose lines help
        if not frames and not isinstance(error, OSError):
            raise error
        reason = _system(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        traced = printable("".join(frames), kept="\n")
        said, status = f"{traced}farm: {printable(reason)}\n", 1
    with suppress(OSError):
        sys.stderr.write(said)
    return status


def _unwritten() -> OSError | None:
    """Why standard output does not take what was written to it, if so; what it did not take is given up then."""
    try:
        sys.stdout.flush()
    except OSError as error:
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error
    return None


def _system(error: OSError) -> str:
    """What the system refused, and what to do about that."""
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

    others = {name: origin for name, origin in plugins.names("commands").items() if name not in COMMANDS}
    rows = "".join(f"  farm {name:<14}{text}\n" for name, text in (COMMANDS | others).items())
    return (
        "rolloutfarm: policy search on any task, with as many MuJoCo workers on as many machines as you like.\n\n"
        f"{rows}\n  farm COMMAND --help says what a command takes; farm --version.\n"
    )


if __name__ == "__main__":
    # `python -m farm` puts the current folder first in the path: nothing is imported from there.
    with suppress(FileNotFoundError):
        if not sys.flags.safe_path and sys.path and sys.path[0] in ("", str(Path.cwd())):
            del sys.path[0]
    sys.exit(main())
