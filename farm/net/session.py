"""Zenoh sessions as the farm uses them; the only module that uses zenoh.

Every subscription has a callback, on its own thread, that moves samples into the application's
queue, so that the link is always drained. The thread that reads the queue owns all state and does
all the publishing. (A thread that waits for one of Zenoh's channels wakes up ten times per second.)
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any, Final, TypeVar

import zenoh

from farm.errors import ConfigError, FarmError, Interrupted
from farm.net import probe
from farm.net.events import Event, Events
from farm.net.forks import begin_zenoh
from farm.net.intake import PERIOD, Intake
from farm.net.rates import Rates
from farm.net.sockets import free_port, raise_descriptors, received, silence
from farm.net.tls import Bundle
from farm.net.zenoh_settings import LARGEST, RECEIVE, client_settings, router_settings

log = logging.getLogger(__name__)

_T = TypeVar("_T")
_TOKENS: Final = 65_536  # most tokens in one query's answer; a router accepts 4096 sessions
_JOIN_S: Final = 1.0
# Answers to one topic's queries take one part in so many of a core's time, at most
_DUTY: Final = 4.0
_CUT: Final = 60.0  # [s] that a machine is cut off
_REMIND: Final = 60.0  # [s] between two messages about the same problem

FLOOD: Final = "flood"
"""Topic of the event that a machine was cut off."""


def free_endpoint() -> str:
    """An endpoint on this machine with an unused port."""
    return f"tcp/127.0.0.1:{free_port()}"


class Session:
    """An open session; use `listen` or `connect`."""

    def __init__(
        self,
        session: zenoh.Session,
        *,
        certified: bool = False,
        viewers: Collection[str] = (),
    ) -> None:
        """Use a session; `certified`: certificates say whose keys are whose; `viewers`: names of
        machines' that ask.
        """
        self._session = session
        self._certified = certified
        self._viewers = frozenset(viewers)
        self._closed = threading.Event()
        self.events = Events()
        """Everything received by subscriptions."""
        self._declared: list[
            zenoh.Subscriber[None] | zenoh.Queryable[None] | zenoh.LinkEventsListener[None]
        ] = []
        self._over: list[threading.Event] = []  # of their callbacks
        self._tokens: list[zenoh.LivelinessToken] = []
        self._prefixes: dict[str, int] = {}  # length of what precedes a sender in a topic's keys
        self.rates = Rates()
        """Rates of the messages that are a burden."""
        self._cut: dict[str, float] = {}  # machines, and until when
        if certified:
            opened = self._callback(self._on_link)
            self._declared.append(
                _as_daemon(lambda: session.info.declare_link_events_listener(opened))
            )
        if viewers:
            threading.Thread(target=self._count, daemon=True).start()

    def publish(
        self, key: str, payload: bytes, *, urgent: bool = False, block: bool = True
    ) -> None:
        """Send bytes to the subscribers of the key; without `block` a receiver that is stuck
        loses them.
        """
        self._session.put(
            key,
            payload,
            congestion_control=zenoh.CongestionControl.BLOCK
            if block
            else zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if urgent else zenoh.Priority.DATA,
        )

    def subscribe(
        self, topic: str, key: str, *, wake: bool = True, most: int | None = None
    ) -> None:
        """Put everything published on the key into `events` under the topic's name.

        Without `wake`, a thread that waits for events is not woken. Of each sender, `most` wait to
        be read; those that are dropped count as a burden.
        """
        callback = self._callback(self._put(topic, key, wake=wake, most=most))
        self._declared.append(_as_daemon(lambda: self._session.declare_subscriber(key, callback)))

    def watch(self, topic: str, key: str) -> None:
        """Put existing, new and disappearing liveliness tokens into `events`."""
        callback = self._callback(self._put(topic, key))
        tokens = self._session.liveliness()
        self._declared.append(
            _as_daemon(lambda: tokens.declare_subscriber(key, callback, history=True))
        )

    def token(self, key: str) -> None:
        """Declare our liveliness token until the session closes.

        Do this after all other declarations.
        """
        self._tokens.append(self._session.liveliness().declare_token(key))

    def outlet(self, key: str) -> "Outlet":
        """A publisher for a key that is used repeatedly and may have no subscribers."""
        return Outlet(
            self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        )

    def answer(self, key: str, reply: Callable[[], bytes]) -> None:
        """Answer every query on the key with the result of `reply`, which Zenoh calls on its
        threads.
        """
        self.answer_asked(key, lambda _: reply())

    def answer_asked(self, key: str, reply: Callable[[str], bytes]) -> None:
        """Answer queries like `answer`, but `reply` takes the query's parameters, the text after
        the key and a question mark.

        Each topic's queries are answered one after the other, and those that come too fast have to
        wait: whoever asks without end takes a quarter of a core, not all of it.
        """

        def serve(query: zenoh.Query) -> None:
            """Answer one. Thread: Zenoh's, this topic's own."""
            start = time.thread_time()
            with query, suppress(zenoh.ZError):
                query.reply(key, reply(str(query.parameters)))
            self._closed.wait((_DUTY - 1.0) * (time.thread_time() - start))

        callback = self._callback(serve)
        self._declared.append(_as_daemon(lambda: self._session.declare_queryable(key, callback)))

    def present(self, key: str, timeout: float) -> bool:
        """Whether a liveliness token of the key is found within the timeout [s]."""
        return bool(self.tokens(key, timeout))

    def tokens(self, key: str, timeout: float) -> list[str]:
        """The liveliness tokens of the key that are found within the timeout [s]."""
        # A router delivers all of them before `get` returns: with room for fewer it would wait
        # forever.
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
            for reply in self._session.get(
                key, timeout=timeout, consolidation=zenoh.ConsolidationMode.NONE
            ):
                if reply.ok is not None:
                    yield reply.ok.payload.to_bytes()

    def burden(self, event: Event) -> None:
        """Count an event against the machine that sent it; with very many, it is cut off.

        Thread: Zenoh's, or main.

        That is an event of the topic FLOOD. Without certificates nobody knows who sent it, and
        nothing is done.
        """
        worker = event.key[self._prefixes[event.topic] :]
        if self._certified and self.rates.flooding(worker, time.monotonic()):
            name = worker.partition("/")[0]
            if self.cut(name):
                self.events.put(Event(FLOOD, name, b""))

    def cut(self, name: str) -> bool:
        """Silence the connections of the machine with this certificate, and for a minute each new
        one; false if done.

        Zenoh's filters drop what it sends only after reading it, on a thread that takes a whole
        core.
        """
        if self._is_cut(name):
            return False
        self._cut[name] = time.monotonic() + _CUT
        role = "viewer" if name in self._viewers else "worker"
        log.warning("machine %s sends more than any %s: it is cut off for %g s", name, role, _CUT)
        threading.Thread(target=self._silence, args=(name,), daemon=True).start()
        return True

    def _count(self) -> None:
        """Cut off viewers that send much: Zenoh says of no query, and no subscription, whose it is.

        Thread: helper.
        """
        intake = Intake()
        while not self._closed.wait(PERIOD):
            links = {
                _address(link): link.auth_identifier or "" for link in self._session.info.links()
            }
            viewers = {address: name for address, name in links.items() if name in self._viewers}
            for name in intake.over(received() if viewers else {}, viewers):
                self.cut(name)

    def _silence(self, name: str) -> None:
        """Silence a machine's connections: callbacks of Zenoh's must not list them.

        Thread: helper.
        """
        silence(
            {_address(link) for link in self._session.info.links() if link.auth_identifier == name}
        )

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        """A machine has connected. Thread: Zenoh's."""
        if event.kind == zenoh.SampleKind.PUT and self._is_cut(event.link.auth_identifier):
            silence({_address(event.link)})

    def _is_cut(self, name: str | None) -> bool:
        return name in self._cut and time.monotonic() < self._cut[name]

    def close(self) -> None:
        """Undeclare everything and wait for the callbacks: one left running in Rust aborts the
        interpreter's exit.
        """
        self._closed.set()
        for token in self._tokens:
            token.undeclare()
        for declared in self._declared:
            declared.undeclare()
        until = time.monotonic() + _JOIN_S
        for over in self._over:
            over.wait(max(0.0, until - time.monotonic()))

    def _put(
        self, topic: str, key: str, *, wake: bool = True, most: int | None = None
    ) -> Callable[[zenoh.Sample], None]:
        self._prefixes[topic] = len(key.removesuffix("**"))

        def put(sample: zenoh.Sample) -> None:
            """A message has arrived. Thread: Zenoh's."""
            alive = sample.kind == zenoh.SampleKind.PUT
            event = Event(topic, str(sample.key_expr), sample.payload.to_bytes(), alive)
            if not self.events.put(event, wake=wake, most=most):
                self.burden(event)

        return put

    def _callback(self, call: Callable[[_T], None]) -> "zenoh.handlers.Callback[_T]":
        over = threading.Event()
        self._over.append(over)
        return zenoh.handlers.Callback(call, over.set)


def _as_daemon(declare: Callable[[], _T]) -> _T:
    """Declare on a daemon thread: Zenoh's callback threads inherit this, and do not keep a program
    from ending.
    """
    result: Future[_T] = Future()

    def run() -> None:
        """Thread: helper."""
        try:
            result.set_result(declare())
        except BaseException as error:
            result.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return result.result()


def _address(link: zenoh.Link) -> str:
    """HOST:PORT of the other side."""
    return link.dst.partition("/")[2]


class Outlet:
    """A publisher for one key; a receiver that is stuck loses messages."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher

    @property
    def heard(self) -> bool:
        """Whether there are subscribers; the check takes 2 us."""
        # Zenoh's stub says bool, but a bool is always true here
        status: Any = self._publisher.matching_status
        return bool(status.matching)

    def publish(self, payload: bytes) -> None:
        """Send bytes to the subscribers."""
        self._publisher.put(payload)


def check_listening(
    endpoint: str,
    farm: str,
    bundle: Bundle | None = None,
    *,
    trusted: bool = False,
) -> None:
    """Check that `listen` could open a session; opens none, with which no process could be forked.

    Raises:
      ConfigError: as `listen`.
    """
    router_settings(endpoint, farm, bundle, trusted=trusted)
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        free_port(host.strip("[]"), int(port))
    except OSError as error:
        raise _cannot_listen(endpoint, error.strerror or str(error)) from None


def _cannot_listen(endpoint: str, reason: str) -> ConfigError:
    return ConfigError(
        f"cannot listen on {endpoint} ({reason}): is the port in use? "
        "choose a different one with --listen"
    )


def listen(
    endpoint: str,
    farm: str,
    bundle: Bundle | None = None,
    *,
    trusted: bool = False,
    routers: tuple[str, ...] = (),
    largest: int = LARGEST,
) -> AbstractContextManager[Session]:
    """A session that workers connect to; `largest` is as in `connect`, for the others see
    `router_settings`.

    Raises:
      ConfigError: an endpoint is malformed, open to other machines without certificates, or its
          port in use.
    """
    settings = router_settings(endpoint, farm, bundle, trusted=trusted, routers=routers)
    try:
        viewers = () if bundle is None else bundle.roster().viewers
        return _closing(
            _open(settings | {RECEIVE: largest}), certified=bundle is not None, viewers=viewers
        )
    except zenoh.ZError as error:
        raise _cannot_listen(endpoint, _first_line(error)) from None


def connect(
    endpoints: tuple[str, ...],
    timeout: float | None,
    stopped: Callable[[], bool],
    bundle: Bundle | None = None,
    *,
    largest: int = LARGEST,
) -> AbstractContextManager[Session]:
    """A session connected to a learner or a router; keeps trying until one answers.

    Args:
      endpoints: where to connect; the first that answers is used.
      bundle: our certificates, for tls endpoints.
      timeout: give up after this time [s]; None: never.
      stopped: called between attempts; true ends them.
      largest: bytes of the largest message to receive, 64 MiB by default; Zenoh drops larger ones
          unread.

    Raises:
      FarmError: no answer in time; Interrupted: it was stopped.
    """
    settings = client_settings(endpoints, bundle) | {RECEIVE: largest}
    return _closing(
        _try(settings, endpoints, timeout, stopped, bundle), certified=bundle is not None
    )


def _try(
    settings: Mapping[str, object],
    endpoints: tuple[str, ...],
    timeout: float | None,
    stopped: Callable[[], bool],
    bundle: Bundle | None,
) -> zenoh.Session:
    where = ", ".join(endpoints)
    start = reminder = time.monotonic()
    while True:
        try:
            return _open(settings)
        except zenoh.ZError as error:
            now = time.monotonic()
            if stopped():
                raise Interrupted(f"stopped before {where} answered") from None
            if timeout is not None and now - start > timeout:
                raise FarmError(
                    f"no answer from {where} after {timeout:g} s: {_why(endpoints, bundle, error)}"
                ) from None
            if now - reminder >= _REMIND or reminder == start:
                reminder = now
                log.warning(
                    "no answer from %s yet, trying again: %s", where, _why(endpoints, bundle, error)
                )
            time.sleep(0.1)  # zenoh itself waits up to _OPEN_S for an address that does not refuse


def _why(endpoints: tuple[str, ...], bundle: Bundle | None, error: Exception) -> str:
    """Why none of the endpoints answers; if a probe finds nothing, in Zenoh's words."""
    reasons = [
        probe.reason(endpoint, bundle) or f"no learner or router ({_first_line(error)})"
        for endpoint in endpoints
    ]
    return "; ".join(
        reasons if len(reasons) == 1 else map(": ".join, zip(endpoints, reasons, strict=True))
    )


def _open(settings: Mapping[str, object]) -> zenoh.Session:
    begin_zenoh()
    raise_descriptors()
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def _closing(
    session: zenoh.Session, *, certified: bool, viewers: Collection[str] = ()
) -> Iterator[Session]:
    opened = Session(session, certified=certified, viewers=viewers)
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
