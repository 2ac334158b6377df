"""This process's own connections."""

import socket
import sys
from contextlib import ExitStack

import pytest

from farm.net.sockets import silence


@pytest.mark.skipif(sys.platform != "linux", reason="other systems close the connection")
@pytest.mark.parametrize(
    ("family", "host", "name"), [(socket.AF_INET, "127.0.0.1", "127.0.0.1"), (socket.AF_INET6, "::1", "[::1]")]
)
def test_a_silenced_connection_receives_nothing_and_stays_open(family: int, host: str, name: str) -> None:
    if family == socket.AF_INET6 and not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server((host, 0), family=family))
        near, far = [], []
        for _ in range(2):
            near.append(stack.enter_context(socket.create_connection((host, listener.getsockname()[1]))))
            far.append(stack.enter_context(listener.accept()[0]))
        silence({f"{name}:{near[0].getsockname()[1]}"})
        for own in near:
            own.sendall(b"hello")
        assert far[1].recv(5) == b"hello"
        far[0].settimeout(0.2)
        with pytest.raises(TimeoutError):
            far[0].recv(5)
        far[0].sendall(b"still open")
        assert near[0].recv(10) == b"still open"
