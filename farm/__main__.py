"""The front door: `farm COMMAND ...`. Every command's help comes from its configuration dataclass."""

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from farm import __version__, plugins
from farm.errors import ConfigError, FarmError, Interrupted

COMMANDS: Final = {
    "run": "learner and local workers together: learns a task and records it",
    "learner": "the learner alone; workers join it from anywhere",
    "worker": "workers alone; they serve whichever learners are there",
    "tasks": "tasks, policies, algorithms and backends: what there is, from where, with its settings",
    "new-task": "writes a task of your own to start from, 30 lines that run",
    "check": "checks a task of your own: sizes, same bits however batched, rollouts per second, a picture",
    "evaluate": "the learnt mean policy on perturbed starts",
    "replay": "any policy of a run again, at physics rate, into a recording or a video",
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
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words else "--help"
    if name in ("-h", "--help", "help"):
        sys.stdout.write(_overview())
        return 0
    if name == "--version":
        sys.stdout.write(f"rolloutfarm {__version__}\n")
        return 0
    try:
        if arguments is None:  # where a command has no better idea, SIGTERM is as Ctrl-C
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        return int(plugins.find("commands", name).target(words[1:]))
    except (KeyboardInterrupt, Exception) as error:
        return _ended(error)


def _ended(error: BaseException) -> int:
    """Say how a command ended, and return its exit status; what is no user's mistake is raised again."""
    if isinstance(error, KeyboardInterrupt | Interrupted):
        said, status = "" if isinstance(error, Interrupted) else "farm: stopped before the end\n", 130
    elif isinstance(error, FarmError):
        said, status = f"farm: {error}\n", 2 if isinstance(error, ConfigError) else 1
    elif isinstance(error, BrokenPipeError):
        sys.stderr.close()
        return 1
    else:  # of a task of the user's own, whose lines are what helps
        frames = plugins.author_frames(error)
        if not frames:
            raise error
        said, status = f"{''.join(frames)}farm: {type(error).__name__}: {error}\n", 1
    sys.stderr.write(said)
    return status


def _overview() -> str:
    others = {name: origin for name, origin in plugins.names("commands").items() if name not in COMMANDS}
    rows = "".join(f"  farm {name:<14}{text}\n" for name, text in (COMMANDS | others).items())
    return (
        "rolloutfarm: policy search on any task, with as many MuJoCo workers on as many machines as you like.\n\n"
        f"{rows}\n  farm COMMAND --help says what a command takes; farm --version.\n"
    )


def _without_here() -> None:
    """`python -m farm` puts the current folder first in the path: nothing is imported from there."""
    if not sys.flags.safe_path and sys.path and sys.path[0] in ("", str(Path.cwd())):
        del sys.path[0]


if __name__ == "__main__":
    _without_here()
    sys.exit(main())
