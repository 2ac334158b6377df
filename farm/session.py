"""Zenoh sessions as the farm uses them; the only door to zenoh.

What is set here was measured: see docs/protocol.md. Every subscription has a thread of its own
that moves samples into the application's queue, so that the link is always drained; whoever
reads the queue owns all state and does all the publishing.
"""

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final, Literal

import zenoh

from farm.errors import ConfigError, FarmError

log = logging.getLogger(__name__)

_CHANNEL: Final = 10_000  # samples a subscription holds before its thread moves them
_LEASE_MS: Final = 3000  # leases under 2 s kill healthy workers on a busy machine
_OPEN_S: Final = 1.0
_JOIN_S: Final = 1.0
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/link/tx/lease": _LEASE_MS,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 300_000,
    "transport/link/rx/max_message_size": 64 * 1024 * 1024,
    "transport/shared_memory/enabled": False,
}
_ROUTER: Final = {
    "mode": "router",
    "transport/unicast/max_sessions": 4096,
    "transport/unicast/accept_pending": 1024,
}
_CLIENT: Final = {
    "mode": "client",
    "connect/timeout_ms": int(_OPEN_S * 1000),
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
}


@dataclass(frozen=True)
class Event:
    """Something that came over a subscription."""

    topic: str
    """Which subscription, as named by its maker."""
    key: str
    payload: bytes
    """Empty for liveliness."""
    alive: bool = True
    """For liveliness: whether the token appeared or went."""


def check_endpoint(endpoint: str) -> str:
    """The endpoint, if it has the form Zenoh takes (it accepts some nonsense silently).

    Raises:
      ConfigError: otherwise.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol != "tcp" or not host or not port.isdigit() or not int(port) < 65536:
        raise ConfigError(f"endpoint {endpoint!r} is not of the form tcp/HOST:PORT, for example tcp/127.0.0.1:7447")
    return endpoint


class Session:
    """An open session; use `listen` or `connect`."""

    def __init__(self, session: zenoh.Session, events: "queue.SimpleQueue[Event]") -> None:
        """Take an open zenoh session and the queue that everything goes into."""
        self._session = session
        self.events = events
        self._threads: list[threading.Thread] = []
        self._declared: list[
            zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | zenoh.Queryable[zenoh.Handler[zenoh.Query]]
        ] = []
        self._tokens: list[zenoh.LivelinessToken] = []

    def publish(self, key: str, payload: bytes, *, urgent: bool = False, block: bool = True) -> None:
        """Send bytes to whoever subscribed to the key; without block a stuck receiver loses them."""
        self._session.put(
            key,
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
        )

    def subscribe(self, topic: str, key: str) -> None:
        """Everything published on the key goes into `events` under the topic's name."""
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(_CHANNEL))
        self._drain(topic, subscriber)

    def watch(self, topic: str, key: str) -> None:
        """Liveliness tokens that are there, come or go, into `events`."""
        subscriber = self._session.liveliness().declare_subscriber(
            key, zenoh.handlers.FifoChannel(_CHANNEL), history=True
        )
        self._drain(topic, subscriber)

    def token(self, key: str) -> None:
        """Show that we are here, until the session closes. Declare it after everything else."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every query on the key with what `reply` gives (called on another thread)."""
        queryable = self._session.declare_queryable(key, zenoh.handlers.FifoChannel(_CHANNEL))
        self._declared.append(queryable)

        def serve() -> None:
            for query in queryable:
                with query, suppress(zenoh.ZError):
                    query.reply(key, reply())

        self._start(serve, f"answer {key}")

    def ask(self, key: str, timeout: float) -> bytes | None:
        """One answer to a query on the key, None when there is none in time [s]."""
        with suppress(zenoh.ZError):
            for reply in self._session.get(key, timeout=timeout):
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
        return None

    def close(self) -> None:
        """Take everything back and wait for the threads: one that is left in Rust aborts the interpreter's exit."""
        for token in self._tokens:
            token.undeclare()
        for declared in self._declared:
            declared.undeclare()
        for thread in self._threads:
            thread.join(_JOIN_S)

    def _drain(self, topic: str, subscriber: "zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]") -> None:
        self._declared.append(subscriber)

        def move() -> None:
            for sample in subscriber:
                alive = sample.kind == zenoh.SampleKind.PUT
                self.events.put(Event(topic, str(sample.key_expr), sample.payload.to_bytes(), alive))

        self._start(move, f"drain {topic}")

    def _start(self, run: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=run, name=name, daemon=True)
        thread.start()
        self._threads.append(thread)


@contextmanager
def listen(endpoint: str) -> Iterator[Session]:
    """A session that is the farm's rendezvous itself.

    Raises:
      ConfigError: the endpoint is malformed, or its port is in use.
    """
    check_endpoint(endpoint)
    try:
        session = _open(_ROUTER, "listen", [endpoint])
    except zenoh.ZError as error:
        raise ConfigError(
            f"cannot listen on {endpoint} ({_first_line(error)}): is the port in use? choose another with --listen"
        ) from None
    with _closing(session) as opened:
        yield opened


@contextmanager
def connect(endpoints: tuple[str, ...], timeout: float | None, stopped: Callable[[], bool]) -> Iterator[Session]:
    """A session that dials a learner or a router, and keeps trying.

    Args:
      endpoints: where to dial; any one that answers will do.
      timeout: give up after [s]; None for never.
      stopped: asked between tries, true ends them.

    Raises:
      FarmError: nobody answered in time, or it was stopped.
    """
    for endpoint in endpoints:
        check_endpoint(endpoint)
    with _closing(_dial(endpoints, timeout, stopped)) as opened:
        yield opened


def _dial(endpoints: tuple[str, ...], timeout: float | None, stopped: Callable[[], bool]) -> zenoh.Session:
    where = ", ".join(endpoints)
    begun = told = time.monotonic()
    while True:
        try:
            return _open(_CLIENT, "connect", list(endpoints))
        except zenoh.ZError as error:
            now = time.monotonic()
            if stopped():
                raise FarmError(f"stopped before {where} answered") from None
            if timeout is not None and now - begun > timeout:
                raise FarmError(
                    f"nobody answers at {where} after {timeout:g} s: start a learner there, or check --connect"
                ) from None
            if now - told >= 3.0 or told == begun:
                told = now
                log.warning("nobody answers at %s yet, trying again (%s)", where, _first_line(error))
            time.sleep(0.1)  # zenoh itself waits up to _OPEN_S for an address that does not refuse


def _open(mode: Mapping[str, object], direction: Literal["listen", "connect"], endpoints: list[str]) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {**_COMMON, **mode, f"{direction}/endpoints": endpoints}.items():
        config.insert_json5(key, json.dumps(value))
    if direction == "connect":
        config.insert_json5("listen/endpoints", "[]")
    return zenoh.open(config)


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[Session]:
    with session:
        opened = Session(session, queue.SimpleQueue())
        try:
            yield opened
        finally:
            opened.close()


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:120] if str(error) else type(error).__name__
