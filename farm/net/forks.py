"""Whether Zenoh has run in this process, or in one that this was forked from: its threads do not
survive a fork.
"""

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
    _with_zenoh.add(os.getpid())


def zenoh_ran() -> bool:
    """Whether it has run here, or where this process was forked."""
    return bool(_with_zenoh)
