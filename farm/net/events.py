"""A queue of received samples: callbacks on other threads put them in, the thread that owns the
state takes them.
"""

import queue
import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import Final

_AT_ONCE: Final = 10_000  # events taken from the queue at a time
# [bytes] of queued events; further ones are dropped, as on a bad network
_BACKLOG: Final = 256 * 1024 * 1024
_OVERHEAD: Final = 500  # [bytes] of an event besides its payload


@dataclass(frozen=True)
class Event:
    """A sample received by a subscription."""

    topic: str
    """Name of the subscription."""
    key: str
    payload: bytes
    """Empty for liveliness."""
    alive: bool = True
    """Whether the token appeared or disappeared, for liveliness only."""


class Events:
    """A first-in, first-out queue of limited size, for each key and in all; further events are
    dropped.

    Not a SimpleQueue: if a signal arrives just before the timeout, Python 3.11's may wait forever.
    """

    def __init__(self) -> None:
        self._events: deque[Event] = deque()
        self._counts: Counter[str] = Counter()  # of queued events, by key
        self._came = threading.Condition()
        self._bytes = self.dropped = 0

    def put(self, event: Event, *, wake: bool = True, most: int | None = None) -> bool:
        """Append an event unless the queue is full, or has `most` with this key; return whether it
        did.

        Thread: Zenoh's, or main. Liveliness events have twice the room, because they are never
        repeated.
        """
        size = _size(event)
        with self._came:
            full = self._bytes + size > (_BACKLOG if event.payload else 2 * _BACKLOG)
            if full or (most is not None and self._counts[event.key] >= most):
                self.dropped += 1
                return False
            self._bytes += size
            self._counts[event.key] += 1
            self._events.append(event)
            if wake:
                self._came.notify()
        return True

    def get(self, timeout: float = 0.0) -> Event:
        """The next event.

        Raises:
          queue.Empty: none arrived in time [s].
        """
        for event in self._take(1, timeout):
            return event
        raise queue.Empty

    def waiting(self, timeout: float) -> list[Event]:
        """Take all queued events; wait for the first one for at most the timeout [s]."""
        return self._take(_AT_ONCE, timeout)

    def _take(self, most: int, timeout: float) -> list[Event]:
        with self._came:
            if timeout > 0.0:
                self._came.wait_for(lambda: self._events, timeout)
            events = [self._events.popleft() for _ in range(min(most, len(self._events)))]
            self._bytes -= sum(map(_size, events))
            self._counts -= Counter(event.key for event in events)
        return events

    def __len__(self) -> int:
        return len(self._events)


def _size(event: Event) -> int:
    return len(event.payload) + len(event.key) + _OVERHEAD
