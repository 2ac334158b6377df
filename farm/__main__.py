"""The front door: `farm COMMAND ...`. Every command's help comes from its configuration dataclass."""

import importlib
import signal
import sys
from collections.abc import Sequence
from typing import Final

from farm import __version__
from farm.errors import ConfigError, FarmError, Interrupted

COMMANDS: Final = {
    "run": "learner and local workers together: learns the gait and records it",
    "learner": "the learner alone; workers join it from anywhere",
    "worker": "workers alone; they serve whichever learners are there",
    "evaluate": "the learnt mean policy on perturbed starts",
    "replay": "any policy of a run again, at physics rate, into a recording or a video",
    "compare": "several runs in one recording: curves overlaid, hands side by side",
    "play": "the learnt policy in MuJoCo's interactive viewer: push the object",
    "export": "the learnt policy as one file for plain MuJoCo and numpy",
    "record": "a run's recording made on any machine, over the network",
    "view": "opens the recordings of runs in the Rerun viewer",
    "status": "which runs and workers a farm has, and how they are doing",
    "router": "a standing rendezvous that outlives learners",
    "certificates": "a small certificate authority, for farms of several machines",
    "runs": "a table of the runs in a folder",
}
"""Commands and what they are for; each is a module of farm.commands with a function `main`."""


_HOME: Final = dict.fromkeys(("status", "router", "certificates"), "farm")


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
        if name not in COMMANDS:
            raise ConfigError(f"unknown command {name!r}; known are {', '.join(COMMANDS)} (see farm --help)")
        if arguments is None:  # where a command has no better idea, SIGTERM is as Ctrl-C
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        module = "workers.command" if name == "worker" else f"{_HOME.get(name, 'learner')}.commands.{name}"
        return int(importlib.import_module(module).main(words[1:]))
    except (KeyboardInterrupt, Interrupted) as end:
        if isinstance(end, KeyboardInterrupt):
            sys.stderr.write("farm: stopped before the end\n")
        return 130
    except FarmError as error:
        sys.stderr.write(f"farm: {error}\n")
        return 2 if isinstance(error, ConfigError) else 1
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def _overview() -> str:
    rows = "".join(f"  farm {name:<14}{text}\n" for name, text in COMMANDS.items())
    return (
        "rolloutfarm: a hand learns to change its grip by touch, on as many machines as you like.\n\n"
        f"{rows}\n  farm COMMAND --help says what a command takes; farm --version.\n"
    )


if __name__ == "__main__":
    sys.exit(main())
