"""What the operating system lets this process open, and the sockets that it has open."""

import os
import socket
import stat
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from farm.errors import FarmError

_DESCRIPTORS: Final = 65_536
_FEWEST: Final = 64  # enough files and connections for a run with two workers
_OPEN: Final = Path("/dev/fd")  # a process' descriptors, on Linux and macOS


def raise_descriptors() -> None:
    """Raise the limit of open files to the system's maximum: the usual 1024 suffice for 1000 workers only.

    A system without such limits, or that does not let them be raised, is left as it is.

    Raises:
      FarmError: the maximum is so low that Zenoh would abort the process.
    """
    try:
        import resource
    except ImportError:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(ValueError):  # macOS has a smaller limit than its "infinite" one
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    if soft != resource.RLIM_INFINITY and soft < _FEWEST:
        raise FarmError(f"a process may open {soft} files here, {_FEWEST} are needed: ulimit -n 1024")


def shut_down(peers: Collection[str]) -> None:
    """End this process's connections to these addresses, HOST:PORT; a host of IPv6 has brackets.

    Zenoh, which has opened them, has no call for one of them; it notices the end as that of any connection. A system
    without a list of a process's descriptors keeps them.
    """
    for own in _connections() if peers else ():
        with own, suppress(OSError):
            host, port, *_ = own.getpeername()
            if f"[{host}]:{port}" in peers or f"{host}:{port}" in peers:
                own.shutdown(socket.SHUT_RDWR)


def _connections() -> Iterator[socket.socket]:
    """Duplicates of this process's sockets of the internet protocols."""
    with suppress(OSError):
        for number in [int(path.name) for path in _OPEN.iterdir()]:
            with suppress(OSError):  # closed in the meantime
                if stat.S_ISSOCK(os.fstat(number).st_mode):
                    own = socket.socket(fileno=os.dup(number))
                    if own.family in (socket.AF_INET, socket.AF_INET6):
                        yield own
                    else:
                        own.close()
