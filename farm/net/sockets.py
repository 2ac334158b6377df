"""What the operating system lets this process open, and the sockets that it has open."""

import ctypes
import os
import socket
import stat
import struct
import sys
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from farm.errors import FarmError

_DESCRIPTORS: Final = 65_536
_FEWEST: Final = 64  # enough files and connections for a run with two workers
_ATTACH_FILTER: Final = 26  # SO_ATTACH_FILTER, which the module socket does not name
# Classic BPF: take segments that are no longer than their header, which acknowledge what we send
_NO_DATA: Final = (
    # A = byte 12 of the TCP header, whose upper half is the header's length in words
    (0x30, 0, 0, 12),
    (0x54, 0, 0, 0xF0),
    (0x74, 0, 0, 2),
    (0x07, 0, 0, 0),  # X = (A & 0xF0) >> 2
    (0x80, 0, 0, 0),
    (0x1D, 0, 1, 0),  # A = the segment's length; if it is not X, skip one
    (0x06, 0, 0, 0xFFFFFFFF),
    (0x06, 0, 0, 0),  # take the segment; take nothing
)
_PROGRAM: Final = ctypes.create_string_buffer(
    b"".join(struct.pack("HBBI", *each) for each in _NO_DATA)
)
_FILTER: Final = struct.pack("HP", len(_NO_DATA), ctypes.addressof(_PROGRAM))  # struct sock_fprog
# The field tcpi_bytes_received of struct tcp_info: Linux 4.1 and later
_TCP_INFO: Final = struct.Struct("=128xQ")
_OPEN: Final = Path("/dev/fd")  # a process' descriptors, on Linux and macOS


def free_port(host: str = "127.0.0.1", port: int = 0) -> int:
    """A port that this process could listen on: the given one, or for 0 any.

    Raises:
      OSError: it is in use, the host is not this machine, or the port is no port.
    """
    try:
        (family, kind, protocol, _, address), *_ = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )
        with socket.socket(family, kind, protocol) as probe:
            # As servers do: connections that have just ended do not keep a port
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except (OverflowError, UnicodeError) as error:
        raise OSError(str(error)) from error


def raise_descriptors() -> None:
    """Raise the limit of open files to the system's maximum: the usual 1024 suffice for 1000
    workers only.

    A system without such limits, or that does not let them be raised, is left as it is.

    Raises:
      FarmError: the maximum is so low that Zenoh would abort the process.
    """
    try:
        import resource
    except ImportError:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < limit:
        with suppress(ValueError):  # macOS has a smaller limit than its "infinite" one
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
            soft = limit
    if soft != resource.RLIM_INFINITY and soft < _FEWEST:
        raise FarmError(
            f"a process may open {soft} files here, {_FEWEST} are needed: ulimit -n 1024"
        )


def silence(peers: Collection[str]) -> None:
    """Let no more data in from these addresses, HOST:PORT, over this process's connections; IPv6
    has brackets.

    What this process sends is still acknowledged, so that nothing waits for the other side.

    Zenoh, which has opened them, has no call for it; it gives up a silent connection when its lease
    is over. One that is closed instead would be opened again within milliseconds, and each time
    costs a handshake: only on systems other than Linux, whose sockets take no filter. A system
    without a list of a process's descriptors changes nothing.
    """
    for connection in _connections() if peers else ():
        with connection, suppress(OSError):
            host, port, *_ = connection.getpeername()
            if f"[{host}]:{port}" in peers or f"{host}:{port}" in peers:
                if sys.platform == "linux":
                    connection.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, _FILTER)
                else:
                    connection.shutdown(socket.SHUT_RDWR)


def received() -> dict[str, int]:
    """Bytes that came in so far over each of this process's connections, by the peer's HOST:PORT;
    IPv6 has brackets.

    Empty on systems other than Linux, which do not count them.
    """
    counts: dict[str, int] = {}
    for connection in _connections() if sys.platform == "linux" else ():
        with connection, suppress(OSError, struct.error):  # one that listens has no peer
            host, port, *_ = connection.getpeername()
            answer = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
            peer = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
            counts[peer] = _TCP_INFO.unpack(answer)[0]
    return counts


def _connections() -> Iterator[socket.socket]:
    """Duplicates of this process's sockets of the internet protocols."""
    with suppress(OSError):
        for number in [int(path.name) for path in _OPEN.iterdir()]:
            with suppress(OSError):  # closed in the meantime
                if stat.S_ISSOCK(os.fstat(number).st_mode):
                    connection = socket.socket(fileno=os.dup(number))
                    if connection.family in (socket.AF_INET, socket.AF_INET6):
                        yield connection
                    else:
                        connection.close()
