"""What subscriptions brought, in a queue: callbacks on other threads put, whoever owns the state gets."""

import queue
import threading
from collections import deque
from dataclasses import dataclass
from typing import Final

_AT_ONCE: Final = 10_000  # events that are taken in before anything else is done
_BACKLOG: Final = 256 * 1024 * 1024  # [bytes] of events that wait; what comes on top is lost, as on a bad network
_OVERHEAD: Final = 500  # [bytes] that an event takes besides its payload


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


class Events:
    """What came in, first come first served; a flood is dropped rather than kept.

    No SimpleQueue: where a signal comes just before its time is over, Python 3.11's may wait for ever.
    """

    def __init__(self) -> None:
        self._events: deque[Event] = deque()
        self._came = threading.Condition()
        self._bytes = self.dropped = 0

    def put(self, event: Event, *, wake: bool = True) -> None:
        """Append an event, unless those that wait take up too much.

        There is twice the room for who comes and goes: nobody would say that again.
        """
        size = _size(event)
        with self._came:
            if self._bytes + size > (_BACKLOG if event.payload else 2 * _BACKLOG):
                self.dropped += 1
                return
            self._bytes += size
            self._events.append(event)
            if wake:
                self._came.notify()

    def get(self, timeout: float = 0.0) -> Event:
        """The next event.

        Raises:
          queue.Empty: none came in time [s].
        """
        for event in self._take(1, timeout):
            return event
        raise queue.Empty

    def waiting(self, timeout: float) -> list[Event]:
        """What waits, after waiting for the first [s]."""
        return self._take(_AT_ONCE, timeout)

    def _take(self, most: int, timeout: float) -> list[Event]:
        with self._came:
            if timeout > 0.0:
                self._came.wait_for(lambda: self._events, timeout)
            events = [self._events.popleft() for _ in range(min(most, len(self._events)))]
            self._bytes -= sum(map(_size, events))
        return events

    def __len__(self) -> int:
        """How many wait."""
        return len(self._events)


def _size(event: Event) -> int:
    return len(event.payload) + len(event.key) + _OVERHEAD
