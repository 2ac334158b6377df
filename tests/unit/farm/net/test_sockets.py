"""This process's own connections."""

import secrets
import socket
import sys
import threading
from contextlib import ExitStack

import pytest

from farm.net.sockets import received, silence


@pytest.mark.skipif(sys.platform != "linux", reason="other systems close the connection")
@pytest.mark.parametrize(
    ("family", "host", "name"),
    [(socket.AF_INET, "127.0.0.1", "127.0.0.1"), (socket.AF_INET6, "::1", "[::1]")],
)
def test_a_silenced_connection_receives_nothing_and_stays_open(
    family: int, host: str, name: str
) -> None:
    if family == socket.AF_INET6 and not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server((host, 0), family=family))
        near, far = [], []
        for _ in range(2):
            near.append(
                stack.enter_context(socket.create_connection((host, listener.getsockname()[1])))
            )
            far.append(stack.enter_context(listener.accept()[0]))
        silence({f"{name}:{near[0].getsockname()[1]}"})
        for client in near:
            client.sendall(b"hello")
        assert far[1].recv(5) == b"hello"
        far[0].settimeout(0.2)
        with pytest.raises(TimeoutError):
            far[0].recv(5)
        # More than any buffer, so that near has to acknowledge it
        payload = secrets.token_bytes(10_000_000)
        sending = threading.Thread(target=far[0].sendall, args=(payload,), daemon=True)
        far[0].settimeout(10.0)
        sending.start()
        near[0].settimeout(10.0)
        got = bytearray()
        while len(got) < len(payload):
            got += near[0].recv(1_000_000)
        sending.join(10.0)
        assert got == payload


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not count them")
@pytest.mark.parametrize(
    ("family", "host", "name"),
    [(socket.AF_INET, "127.0.0.1", "127.0.0.1"), (socket.AF_INET6, "::1", "[::1]")],
)
def test_bytes_that_came_in_are_counted_by_connection(family: int, host: str, name: str) -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server((host, 0), family=family))
        address = (host, listener.getsockname()[1])
        near = stack.enter_context(socket.create_connection(address))
        far = stack.enter_context(listener.accept()[0])
        near.sendall(b"x" * 5000)
        got = 0
        while got < 5000:
            got += len(far.recv(5000))
        assert received()[f"{name}:{near.getsockname()[1]}"] == 5000
