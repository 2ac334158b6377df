"""Zenoh sessions as the farm uses them; the only module that uses zenoh.

The settings here were measured: see docs/protocol.md. Every subscription has a callback, on its own thread, that moves
samples into the application's queue, so that the link is always drained. The thread that reads the queue owns all state
and does all the publishing. (A thread that waits for one of Zenoh's channels wakes up ten times per second.)
"""

import ipaddress
import json
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, Final, TypeVar

import zenoh

from farm.errors import ConfigError, FarmError, Interrupted
from farm.net import keys, probe
from farm.net.events import Event, Events
from farm.net.tls import Bundle, access_control

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_TOKENS: Final = 65_536  # most tokens in one query's answer; a router accepts 4096 sessions
_LEASE_MS: Final = 3000  # leases under 2 s kill healthy workers on a busy machine
_DESCRIPTORS: Final = 65_536
_PORT: Final = re.compile(r"[0-9]{1,5}")
_FEWEST: Final = 64  # enough files and connections for a run with two workers
_OPEN_S: Final = 1.0
_JOIN_S: Final = 1.0
_REQUEST: Final = 65_536  # [bytes] of a request for work
_REQUESTS: Final = 1000.0  # [1/s] requests per link; one that is dropped is sent again within a second
_REMIND: Final = 60.0  # [s] between two messages about the same problem
_LARGEST: Final = 64 * 1024 * 1024  # [bytes] of a message
_RECEIVE: Final = "transport/link/rx/max_message_size"
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/link/tx/lease": _LEASE_MS,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
    "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 300_000,
    _RECEIVE: _LARGEST,
    "transport/shared_memory/enabled": False,
}
_ROUTER: Final = {
    "mode": "router",
    "transport/unicast/max_sessions": 4096,
    # Connections that say nothing take 10 s and some 10 kB each; while there are so many, nobody else can join.
    "transport/unicast/accept_pending": 8192,
}
_RETRY: Final = {"connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}}
_CLIENT: Final = {"mode": "client", "connect/timeout_ms": int(_OPEN_S * 1000), **_RETRY}


def is_port(text: str) -> bool:
    """Whether a text is a port's number."""
    return bool(_PORT.fullmatch(text)) and 0 < int(text) < 65536


def check_endpoint(endpoint: str, *, encrypted: bool = False) -> str:
    """Check an endpoint's form, and return its host (Zenoh silently accepts some malformed ones).

    Args:
      endpoint: tcp/HOST:PORT, or tls/HOST:PORT with certificates.
      encrypted: whether there are certificates.

    Raises:
      ConfigError: it is malformed, or certificates and protocol do not match.
    """
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls") or not host or not (is_port(port) or port == "0"):
        raise ConfigError(f"endpoint {endpoint!r} is not of the form tcp/HOST:PORT, for example tcp/127.0.0.1:7447")
    if protocol == "tls" and not encrypted:
        raise ConfigError(f"endpoint {endpoint} needs certificates: give their folder with --tls")
    if protocol == "tcp" and encrypted:
        raise ConfigError(f"endpoint {endpoint} is not encrypted, but --tls is given: use tls/{address}")
    return host


def _reachable(host: str) -> bool:
    """Whether other machines may be able to connect to a listener on this host."""
    try:
        return not ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host != "localhost"


LISTEN: Final = "tcp/127.0.0.1:7447"
"""A learner's default endpoint."""


def free_endpoint() -> str:
    """An endpoint on this machine with an unused port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Session:
    """An open session; use `listen` or `connect`."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.events = Events()
        """Everything received by subscriptions."""
        self._declared: list[zenoh.Subscriber[None] | zenoh.Queryable[None]] = []
        self._over: list[threading.Event] = []  # of their callbacks
        self._tokens: list[zenoh.LivelinessToken] = []

    def publish(self, key: str, payload: bytes, *, urgent: bool = False, block: bool = True) -> None:
        """Send bytes to the subscribers of the key; without `block` a receiver that is stuck loses them."""
        self._session.put(
            key,
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
        )

    def subscribe(self, topic: str, key: str, *, wake: bool = True, most: int | None = None) -> None:
        """Put everything published on the key into `events` under the topic's name.

        Without `wake`, a thread that waits for events is not woken. Of each sender, `most` wait to be read.
        """
        callback = self._callback(self._put(topic, wake=wake, most=most))
        self._declared.append(_as_daemon(lambda: self._session.declare_subscriber(key, callback)))

    def watch(self, topic: str, key: str) -> None:
        """Put existing, new and disappearing liveliness tokens into `events`."""
        callback = self._callback(self._put(topic))
        tokens = self._session.liveliness()
        self._declared.append(_as_daemon(lambda: tokens.declare_subscriber(key, callback, history=True)))

    def token(self, key: str) -> None:
        """Declare our liveliness token until the session closes. Do this after all other declarations."""
        self._tokens.append(self._session.liveliness().declare_token(key))

    def outlet(self, key: str) -> "Outlet":
        """A publisher for a key that is used repeatedly and may have no subscribers."""
        return Outlet(self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP))

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every query on the key with the result of `reply` (called on another thread)."""
        self.answer_asked(key, lambda _: reply())

    def answer_asked(self, key: str, reply: Callable[[str], bytes]) -> None:
        """Like `answer`, where `reply` takes the query's parameters (the text after the key and a question mark)."""

        def serve(query: zenoh.Query) -> None:
            with query, suppress(zenoh.ZError):
                query.reply(key, reply(str(query.parameters)))

        callback = self._callback(serve)
        self._declared.append(_as_daemon(lambda: self._session.declare_queryable(key, callback)))

    def present(self, key: str, timeout: float) -> bool:
        """Whether a liveliness token of the key is found within the timeout [s]."""
        return bool(self.tokens(key, timeout))

    def tokens(self, key: str, timeout: float) -> list[str]:
        """The liveliness tokens of the key that are found within the timeout [s]."""
        # A router delivers all of them before `get` returns: with room for fewer it would wait forever.
        room = zenoh.handlers.FifoChannel(_TOKENS)
        replies = self._session.liveliness().get(key, room, timeout=timeout)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def ask(self, key: str, timeout: float) -> bytes | None:
        """One answer to a query on the key, None if there is none within the timeout [s]."""
        return next(self.ask_all(key, timeout), None)

    def ask_all(self, key: str, timeout: float) -> Iterator[bytes]:
        """Every answer to a query on the key that arrives within the timeout [s]."""
        with suppress(zenoh.ZError):
            # Not consolidated: two answers on the same key are both kept.
            for reply in self._session.get(key, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE):
                if reply.ok is not None:
                    yield reply.ok.payload.to_bytes()

    def close(self) -> None:
        """Undeclare everything and wait for the callbacks: one left running in Rust aborts the interpreter's exit."""
        for token in self._tokens:
            token.undeclare()
        for declared in self._declared:
            declared.undeclare()
        for over in self._over:
            over.wait(_JOIN_S)

    def _put(self, topic: str, *, wake: bool = True, most: int | None = None) -> Callable[[zenoh.Sample], None]:
        def put(sample: zenoh.Sample) -> None:
            alive = sample.kind == zenoh.SampleKind.PUT
            event = Event(topic, str(sample.key_expr), sample.payload.to_bytes(), alive)
            self.events.put(event, wake=wake, most=most)

        return put

    def _callback(self, call: Callable[[_T], None]) -> "zenoh.handlers.Callback[_T]":
        over = threading.Event()
        self._over.append(over)
        return zenoh.handlers.Callback(call, over.set)


def _as_daemon(declare: Callable[[], _T]) -> _T:
    """Declare on a daemon thread: Zenoh's callback threads inherit this, and do not keep a program from ending."""
    made: Future[_T] = Future()

    def run() -> None:
        try:
            made.set_result(declare())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return made.result()


class Outlet:
    """A publisher for one key; a receiver that is stuck loses messages."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    @property
    def heard(self) -> bool:
        """Whether there are subscribers; the check takes 2 us."""
        status: Any = self._publisher.matching_status  # its stub says bool, but a bool is always true here
        return bool(status.matching)

    def publish(self, payload: bytes) -> None:
        """Send bytes to the subscribers."""
        self._publisher.put(payload)


def router_settings(
    endpoint: str, farm: str, bundle: Bundle | None, *, trusted: bool = False, routers: tuple[str, ...] = ()
) -> dict[str, object]:
    """Zenoh's settings for a session that accepts connections, by configuration path.

    Args:
      endpoint: where it listens.
      farm: name of the farm, for access control.
      bundle: the learner's certificates; with them only machines on its roster are accepted.
      trusted: listen to other machines without certificates.
      routers: other routers that it connects to, and reconnects to after a loss.

    Raises:
      ConfigError: an endpoint is malformed, or open to other machines without certificates.
    """
    host, *_ = (check_endpoint(each, encrypted=bundle is not None) for each in (endpoint, *routers))
    if bundle is None and _reachable(host) and not trusted:
        raise ConfigError(
            f"{endpoint} can be reached by other machines: protect it (farm certificates, --tls), or say "
            "--trust-network if everyone on that network may read everything and pose as a worker"
        )
    secured: dict[str, object] = {}
    if bundle:
        secured = {**bundle.settings("listen"), **_limits(farm)}
        secured["access_control"] = access_control(farm, bundle.roster())
    settings = {**_COMMON, **_ROUTER, **secured, "listen/endpoints": [endpoint]}
    if routers:
        joined = bundle.settings("connect") if bundle else {}
        settings |= {"connect/endpoints": list(routers), **_RETRY, **joined}
    return settings


def _limits(farm: str) -> dict[str, object]:
    """Zenoh's filters of what comes in: large requests, and more of them than any farm sends over one link."""
    asked, common = keys.want(farm, "**"), {"flows": ["ingress"], "messages": ["put"]}
    return {
        "low_pass_filter": [{**common, "key_exprs": [asked], "size_limit": _REQUEST}],
        "downsampling": [{**common, "rules": [{"key_expr": asked, "freq": _REQUESTS}]}],
    }


def listen(
    endpoint: str, farm: str, bundle: Bundle | None = None, *, trusted: bool = False, routers: tuple[str, ...] = (),
    largest: int = _LARGEST,
) -> AbstractContextManager[Session]:  # fmt: skip
    """A session that workers connect to; `largest` is as in `connect`, for the others see `router_settings`.

    Raises:
      ConfigError: an endpoint is malformed, open to other machines without certificates, or its port in use.
    """
    settings = router_settings(endpoint, farm, bundle, trusted=trusted, routers=routers)
    try:
        return _closing(_open(settings | {_RECEIVE: largest}))
    except zenoh.ZError as error:
        raise ConfigError(
            f"cannot listen on {endpoint} ({_first_line(error)}): is the port in use? "
            "choose a different one with --listen"
        ) from None


def _raise_descriptors() -> None:
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


def connect(
    endpoints: tuple[str, ...], timeout: float | None, stopped: Callable[[], bool], bundle: Bundle | None = None, *,
    largest: int = _LARGEST,
) -> AbstractContextManager[Session]:  # fmt: skip
    """A session connected to a learner or a router; keeps trying until one answers.

    Args:
      endpoints: where to connect; the first that answers is used.
      bundle: our certificates, for tls endpoints.
      timeout: give up after this time [s]; None: never.
      stopped: called between attempts; true ends them.
      largest: bytes of the largest message to receive, 64 MiB by default; Zenoh drops larger ones unread.

    Raises:
      FarmError: no answer in time; Interrupted: it was stopped.
    """
    for endpoint in endpoints:
        check_endpoint(endpoint, encrypted=bundle is not None)
    settings = {**_COMMON, **_CLIENT, "connect/endpoints": list(endpoints), "listen/endpoints": [], _RECEIVE: largest}
    if bundle is not None:
        settings |= bundle.settings("connect")
    return _closing(_try(settings, endpoints, timeout, stopped, bundle))


def _try(
    settings: Mapping[str, object],
    endpoints: tuple[str, ...],
    timeout: float | None,
    stopped: Callable[[], bool],
    bundle: Bundle | None,
) -> zenoh.Session:
    where = ", ".join(endpoints)
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
                    f"no answer from {where} after {timeout:g} s: {_why(endpoints, bundle, error)}"
                ) from None
            if now - told >= _REMIND or told == begun:
                told = now
                log.warning("no answer from %s yet, trying again: %s", where, _why(endpoints, bundle, error))
            time.sleep(0.1)  # zenoh itself waits up to _OPEN_S for an address that does not refuse


def _why(endpoints: tuple[str, ...], bundle: Bundle | None, error: Exception) -> str:
    """Why none of the endpoints answers; if a probe finds nothing, in Zenoh's words."""
    found = [probe.reason(endpoint, bundle) or f"no learner or router ({_first_line(error)})" for endpoint in endpoints]
    return "; ".join(found if len(found) == 1 else map(": ".join, zip(endpoints, found, strict=True)))


def _open(settings: Mapping[str, object]) -> zenoh.Session:
    _raise_descriptors()
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def _closing(session: zenoh.Session) -> Iterator[Session]:
    opened = Session(session)
    try:
        yield opened
    finally:
        opened.close()
        with suppress(zenoh.ZError):  # it waits for connections that say nothing, and gives up
            session.close()


def _first_line(error: Exception) -> str:
    """Zenoh's message without the location in its sources."""
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].partition(" at /")[0][:120]
