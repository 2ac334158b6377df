"""Whether Zenoh has run in this process, or in one that this was forked from: its threads do not
survive a fork.
"""

import gc
import os

from farm.errors import RunError

_with_zenoh: set[int] = set()  # ids of processes


def begin_zenoh() -> None:
    """Note that Zenoh runs in this process from now on.

    Raises:
      RunError: it ran in a process that this one was forked from, so that it would wait for threads
          that are not here.
    """
    if _with_zenoh - {os.getpid()}:
        raise RunError(
            "this process was forked from one that has used a farm, and a fork lacks its threads:"
            ' start it as a new process (multiprocessing.get_context("spawn"), subprocess), or use'
            " the farm in the child only"
        )
    if not _with_zenoh and hasattr(os, "register_at_fork"):
        # A closed session may still be garbage in a cycle, and its end waits for Zenoh's threads: a
        # fork, which lacks them, must not collect what it inherits.
        os.register_at_fork(after_in_child=gc.freeze)
    _with_zenoh.add(os.getpid())


def zenoh_ran() -> bool:
    """Whether Zenoh has run in this process, or in one that this was forked from."""
    return bool(_with_zenoh)
