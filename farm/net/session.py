"""Zenoh sessions as the farm uses them; the only door to zenoh.

What is set here was measured: see docs/protocol.md. Every subscription has a callback, on a thread
of its own, that moves samples into the application's queue, so that the link is always drained;
whoever reads the queue owns all state and does all the publishing. (Zenoh's channels would do as
well, but who waits for one wakes up ten times a second.)
"""

import ipaddress
import json
import logging
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Final, TypeVar

import zenoh

from farm.errors import ConfigError, FarmError, Interrupted
from farm.net.events import Event, Events
from farm.net.tls import Bundle, access_control

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_TOKENS: Final = 65_536  # that one question for them may bring; a router takes 4096 sessions
_LEASE_MS: Final = 3000  # leases under 2 s kill healthy workers on a busy machine
_DESCRIPTORS: Final = 65_536
_FEWEST: Final = 64  # files and connections of a run with two workers, and some more
_OPEN_S: Final = 1.0
_JOIN_S: Final = 1.0
_REMIND: Final = 60.0  # [s] between two lines about the same trouble
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
_RETRY: Final = {"connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}}
_CLIENT: Final = {"mode": "client", "connect/timeout_ms": int(_OPEN_S * 1000), **_RETRY}


def check_endpoint(endpoint: str, *, encrypted: bool = False) -> str:
    """The host of an endpoint, if it has the form Zenoh takes (it accepts some nonsense silently).

    Args:
      endpoint: tcp/HOST:PORT, or tls/HOST:PORT with certificates.
      encrypted: whether there are certificates.

    Raises:
      ConfigError: another form, or certificates and protocol do not go together.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not host or not port.isdigit() or not int(port) < 65536:
        raise ConfigError(f"endpoint {endpoint!r} is not of the form tcp/HOST:PORT, for example tcp/127.0.0.1:7447")
    if protocol == "tls" and not encrypted:
        raise ConfigError(f"endpoint {endpoint} needs certificates: give their folder with --tls")
    if protocol == "tcp" and encrypted:
        raise ConfigError(f"endpoint {endpoint} is not encrypted, but --tls is given: take tls/{address}")
    return host


def _reachable(host: str) -> bool:
    """Whether other machines may be able to reach what listens there."""
    try:
        return not ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host != "localhost"


LISTEN: Final = "tcp/127.0.0.1:7447"
"""Where a learner listens unless told otherwise."""


def free_endpoint() -> str:
    """An endpoint on this machine with a port that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Session:
    """An open session; use `listen` or `connect`."""

    def __init__(self, session: zenoh.Session) -> None:
        """Take an open zenoh session."""
        self._session = session
        self.events = Events()
        """Whatever subscriptions bring."""
        self._declared: list[zenoh.Subscriber[None] | zenoh.Queryable[None]] = []
        self._over: list[threading.Event] = []  # of their callbacks
        self._tokens: list[zenoh.LivelinessToken] = []

    def publish(self, key: str, payload: bytes, *, urgent: bool = False, block: bool = True) -> None:
        """Send bytes to whoever subscribed to the key; without block a stuck receiver loses them."""
        self._session.put(
            key,
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
        )

    def subscribe(self, topic: str, key: str, *, wake: bool = True) -> None:
        """Everything published on the key goes into `events` under the topic's name.

        Without `wake`, a thread that waits for events goes on waiting, and finds it with the next one that wakes it.
        """
        self._declared.append(self._session.declare_subscriber(key, self._callback(self._put(topic, wake=wake))))

    def watch(self, topic: str, key: str) -> None:
        """Liveliness tokens that are there, come or go, into `events`."""
        callback = self._callback(self._put(topic))
        self._declared.append(self._session.liveliness().declare_subscriber(key, callback, history=True))

    def token(self, key: str) -> None:
        """Show that we are here, until the session closes. Declare it after everything else."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def outlet(self, key: str) -> "Outlet":
        """A key that is published on again and again, and may have nobody listening."""
        publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        return Outlet(publisher)

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every query on the key with what `reply` gives (called on another thread)."""
        self.answer_asked(key, lambda _: reply())

    def answer_asked(self, key: str, reply: Callable[[str], bytes]) -> None:
        """The same, where `reply` takes what the asker wrote behind the key and a question mark."""

        def serve(query: zenoh.Query) -> None:
            with query, suppress(zenoh.ZError):
                query.reply(key, reply(str(query.parameters)))

        self._declared.append(self._session.declare_queryable(key, self._callback(serve)))

    def present(self, key: str, timeout: float) -> bool:
        """Whether a liveliness token of the key is there, as far as is known in time [s]."""
        return bool(self.tokens(key, timeout))

    def tokens(self, key: str, timeout: float) -> list[str]:
        """The liveliness tokens of the key that are there, as far as is known in time [s]."""
        # A router knows them all and gives them before `get` returns: with room for fewer it would wait for ever.
        room = zenoh.handlers.FifoChannel(_TOKENS)
        replies = self._session.liveliness().get(key, room, timeout=timeout)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def ask(self, key: str, timeout: float) -> bytes | None:
        """One answer to a query on the key, None when there is none in time [s]."""
        return next(self.ask_all(key, timeout), None)

    def ask_all(self, key: str, timeout: float) -> Iterator[bytes]:
        """Every answer to a query on the key that comes in time [s]."""
        with suppress(zenoh.ZError):
            # Not consolidated: two that answer on one key are two answers.
            for reply in self._session.get(key, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE):
                if reply.ok is not None:
                    yield reply.ok.payload.to_bytes()

    def close(self) -> None:
        """Take everything back and wait for the callbacks: one that is left in Rust aborts the interpreter's exit."""
        for token in self._tokens:
            token.undeclare()
        for declared in self._declared:
            declared.undeclare()
        for over in self._over:
            over.wait(_JOIN_S)

    def _put(self, topic: str, *, wake: bool = True) -> Callable[[zenoh.Sample], None]:
        def put(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            self.events.put(Event(topic, str(sample.key_expr), sample.payload.to_bytes(), alive), wake=wake)

        return put

    def _callback(self, call: Callable[[_T], None]) -> "zenoh.handlers.Callback[_T]":
        over = threading.Event()
        self._over.append(over)
        return zenoh.handlers.Callback(call, over.set)


class Outlet:
    """A key to publish on; a receiver that is stuck loses what is said."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        """Made by `Session.outlet`."""
        self._publisher = publisher

    @property
    def heard(self) -> bool:
        """Whether anybody subscribed; asking costs 2 us."""
        status: Any = self._publisher.matching_status  # its stub says bool, which the object always is
        return bool(status.matching)

    def publish(self, payload: bytes) -> None:
        """Send bytes to whoever subscribed."""
        self._publisher.put(payload)


def router_settings(
    endpoint: str, farm: str, bundle: Bundle | None, *, trusted: bool = False, routers: tuple[str, ...] = ()
) -> dict[str, object]:
    """Zenoh's settings for a session that others connect to, by the paths of its configuration.

    Args:
      endpoint: where it listens.
      farm: name of the farm, for access control.
      bundle: the learner's certificates; with them only those on its roster get in.
      trusted: listen to other machines without certificates.
      routers: other ones that it joins, as soon and as often as they are there.

    Raises:
      ConfigError: an endpoint is malformed, or open to other machines without certificates.
    """
    host, *_ = (check_endpoint(each, encrypted=bundle is not None) for each in (endpoint, *routers))
    if bundle is None and _reachable(host) and not trusted:
        raise ConfigError(
            f"{endpoint} can be reached by other machines: protect it (farm certificates, --tls), or say "
            "--trust-network if everybody on that network may read everything and pose as a worker"
        )
    secured = {} if bundle is None else {**bundle.listening(), "access_control": access_control(farm, bundle.roster())}
    settings = {**_COMMON, **_ROUTER, **secured, "listen/endpoints": [endpoint]}
    if routers:
        settings |= {"connect/endpoints": list(routers), **_RETRY, **({} if bundle is None else bundle.connecting())}
    return settings


@contextmanager
def listen(
    endpoint: str, farm: str, bundle: Bundle | None = None, *, trusted: bool = False, routers: tuple[str, ...] = ()
) -> Iterator[Session]:
    """A session that is the farm's rendezvous itself; for the arguments see `router_settings`.

    Raises:
      ConfigError: an endpoint is malformed, open to other machines without certificates, or its port in use.
    """
    settings = router_settings(endpoint, farm, bundle, trusted=trusted, routers=routers)
    try:
        session = _open(settings)
    except zenoh.ZError as error:
        raise ConfigError(
            f"cannot listen on {endpoint} ({_first_line(error)}): is the port in use? choose another with --listen"
        ) from None
    with _closing(session) as opened:
        yield opened


def _raise_descriptors() -> None:
    """Let this process have as many connections as the system allows it: the usual 1024 end at 1000 workers.

    Raises:
      FarmError: they are too few for any: Zenoh would abort the process.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, _DESCRIPTORS)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    if soft != resource.RLIM_INFINITY and soft < _FEWEST:
        raise FarmError(f"a process may open {soft} files here, {_FEWEST} are needed: ulimit -n 1024")


@contextmanager
def connect(
    endpoints: tuple[str, ...], timeout: float | None, stopped: Callable[[], bool], bundle: Bundle | None = None
) -> Iterator[Session]:
    """A session that connects a learner or a router, and keeps trying.

    Args:
      endpoints: where to connect; any one that answers will do.
      bundle: our certificates, for tls endpoints.
      timeout: give up after [s]; None for never.
      stopped: asked between tries, true ends them.

    Raises:
      FarmError: nobody answered in time; Interrupted: it was stopped.
    """
    for endpoint in endpoints:
        check_endpoint(endpoint, encrypted=bundle is not None)
    settings = {**_COMMON, **_CLIENT, "connect/endpoints": list(endpoints), "listen/endpoints": []}
    if bundle is not None:
        settings |= bundle.connecting()
    with _closing(_try(settings, ", ".join(endpoints), timeout, stopped)) as opened:
        yield opened


def _try(
    settings: Mapping[str, object], where: str, timeout: float | None, stopped: Callable[[], bool]
) -> zenoh.Session:
    # A refused handshake looks like nobody: Zenoh does not say why.
    hint = (
        "; the learner may refuse our certificate: same authority, still valid, on its roster?"
        if "tls/" in where
        else ""
    )
    begun = told = time.monotonic()
    while True:
        try:
            return _open(settings)
        except zenoh.ZError as error:
            now = time.monotonic()
            if stopped():
                raise Interrupted(f"stopped before {where} answered") from None
            if timeout is not None and now - begun > timeout:
                raise FarmError(
                    f"nobody answers at {where} after {timeout:g} s: start a learner there, or check --connect{hint}"
                ) from None
            if now - told >= _REMIND or told == begun:
                told = now
                log.warning("nobody answers at %s yet, trying again (%s)%s", where, _first_line(error), hint)
            time.sleep(0.1)  # zenoh itself waits up to _OPEN_S for an address that does not refuse


def _open(settings: Mapping[str, object]) -> zenoh.Session:
    _raise_descriptors()
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[Session]:
    with session:
        opened = Session(session)
        try:
            yield opened
        finally:
            opened.close()


def _first_line(error: Exception) -> str:
    """What zenoh says, without where in its sources."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].partition(" at /")[0][:120]
