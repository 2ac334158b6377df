"""One worker process: `python -m workers`.

People use `farm worker`, which starts as many as there are cores.
"""

import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from farm import command_line
from farm.commands.logs import Formatter
from farm.errors import ConfigError, FarmError, described, printable, short_of_memory
from farm.processes import default_signals_in_forks, leave_nothing
from farm.settings import Settings
from workers.config import WorkerConfig
from workers.worker import work

BROKEN = 70
"""Exit status after an error of the software itself, as in sysexits.h.

The parent may start another worker.
"""


@dataclass(frozen=True, kw_only=True)
class Process(Settings):
    """One worker process."""

    worker: WorkerConfig
    exit_with_parent: bool = False
    """End when standard input closes."""
    log_level: str = "INFO"
    """DEBUG, INFO, WARNING or ERROR."""


def main(words: Sequence[str]) -> int:
    """Serve until SIGTERM, SIGHUP, Ctrl-C, or the end of the parent; exit status."""
    stop = threading.Event()
    default_signals_in_forks()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: stop.set())
    try:
        process = command_line.parse(Process, words, "python -m workers")
        handler = logging.StreamHandler()
        handler.setFormatter(Formatter("%(levelname).1s worker %(process)d: %(message)s"))
        logging.basicConfig(level=process.log_level, handlers=[handler])
        if process.exit_with_parent:
            threading.Thread(target=_watch_parent, args=(stop,), daemon=True).start()
        work(process.worker, stop.is_set)
    except ConfigError as error:
        sys.stderr.write(printable(f"farm worker: {error}") + "\n")
        return 2
    except FarmError as error:
        if not stop.is_set():
            sys.stderr.write(printable(f"farm worker: {error}") + "\n")
            return 1
    except Exception as error:
        if short := short_of_memory(error):
            sys.stderr.write(printable(f"farm worker: {described(error)}; {short}") + "\n")
            return 1
        logging.exception("this worker failed")
        return BROKEN
    return 0


def _watch_parent(stop: threading.Event) -> None:
    """Stop when the other end of standard input is closed. Thread: helper."""
    while os.read(0, 1024):
        pass
    stop.set()


if __name__ == "__main__":
    ended = main(sys.argv[1:])
    leave_nothing()
    sys.exit(ended)
