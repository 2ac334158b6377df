"""Ctrl-C, SIGTERM and SIGHUP as a flag that long work checks."""

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

log = logging.getLogger(__name__)

INTERRUPTED: Final = 130
"""Exit status after Ctrl-C, SIGTERM or SIGHUP, as of a shell after Ctrl-C."""


@contextmanager
def stop_flag(doing: str = "ending", *, at_once: bool = False) -> Iterator[threading.Event]:
    """Set by the first Ctrl-C, SIGTERM or SIGHUP, with a message; a second Ctrl-C ends the program
    at once.

    With `at_once` the first one also raises KeyboardInterrupt: for work in this thread that looks
    at no flag.
    """
    flag = threading.Event()
    names = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "SIGHUP"}
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:  # as by nohup
        del names[signal.SIGHUP]

    def handle(number: int, _: object) -> None:
        if flag.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not flag.is_set():
            flag.set()
            # On a separate thread: this one may be in the middle of writing a message.
            # The space separates it from the ^C that a terminal shows.
            threading.Thread(
                target=log.warning, args=(" %s: %s", names[signal.Signals(number)], doing)
            ).start()
            if at_once:
                raise KeyboardInterrupt

    before = {number: signal.signal(number, handle) for number in names}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
