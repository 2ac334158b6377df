"""Ctrl-C and SIGTERM as a flag that long work looks at."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_flag(doing: str = "ending") -> Iterator[threading.Event]:
    """Set by the first Ctrl-C or SIGTERM, which says what is done now; a second Ctrl-C ends the program at once."""
    flag = threading.Event()
    said = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}

    def handle(number: int, _: object) -> None:
        if flag.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        # Not by sys.stderr: the signal may have come while that was being written to.
        os.write(2, f"\n{said[signal.Signals(number)]}: {doing}\n".encode())
        flag.set()

    before = {number: signal.signal(number, handle) for number in said}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
