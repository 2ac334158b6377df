"""What subscriptions brought, in a queue: callbacks on other threads put, whoever owns the state gets."""

import queue
import threading
from contextlib import suppress
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
    """What came in, first come first served; a flood is dropped rather than kept."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._lock, self._bytes, self.dropped = threading.Lock(), 0, 0

    def put(self, event: Event) -> None:
        """Append an event, unless those that wait take up too much.

        There is twice the room for who comes and goes: nobody would say that again.
        """
        size = _size(event)
        with self._lock:
            if self._bytes + size > (_BACKLOG if event.payload else 2 * _BACKLOG):
                self.dropped += 1
                return
            self._bytes += size
        self._queue.put(event)

    def get(self, timeout: float = 0.0) -> Event:
        """The next event.

        Raises:
          queue.Empty: none came in time [s].
        """
        event = self._queue.get(timeout=timeout) if timeout > 0.0 else self._queue.get_nowait()
        with self._lock:
            self._bytes -= _size(event)
        return event

    def waiting(self, timeout: float) -> list[Event]:
        """What waits, after waiting for the first [s]."""
        events = []
        with suppress(queue.Empty):
            events.append(self.get(timeout))
            while len(events) < _AT_ONCE:
                events.append(self.get())
        return events

    def __len__(self) -> int:
        """How many wait."""
        return self._queue.qsize()


def _size(event: Event) -> int:
    return len(event.payload) + len(event.key) + _OVERHEAD
