"""Real sessions on loopback."""

import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack

from farm.net import keys
from farm.net.session import Session, connect, free_endpoint, listen

MANY = 600  # more than the 256 that a channel of Zenoh's holds by itself


def within(seconds: float, call: Callable[[], None]) -> bool:
    """Whether a call ends in time; one that does not must not hold up the tests."""
    over = threading.Event()
    threading.Thread(target=lambda: (call(), over.set()), daemon=True).start()
    return over.wait(seconds)


def test_many_tokens_are_all_found() -> None:
    endpoint = free_endpoint()
    with listen(endpoint, "f") as router, connect((endpoint,), 10, lambda: False) as worker:
        for i in range(MANY):
            worker.token(keys.worker_token("f", f"w/{i}"))
        tokens: dict[Session, list[str]] = {}

        def look() -> None:
            for side in (router, worker):
                while len(tokens.get(side, ())) < MANY:
                    tokens[side] = side.tokens(keys.worker_token("f", "**"), 1.0)

        assert within(30, look), (
            f"it waits for ever, or finds {[len(names) for names in tokens.values()]}"
        )
        assert all(len(set(names)) == MANY for names in tokens.values())


def test_connections_that_say_nothing_keep_nobody_out() -> None:
    endpoint = free_endpoint()
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with listen(endpoint, "farm"), ExitStack() as silent:
        for _ in range(1500):
            silent.enter_context(socket.create_connection((host, int(port))))
        with connect((endpoint,), 5.0, lambda: False):
            pass
