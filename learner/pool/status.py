"""The answer to `farm status`, made by the learner's thread and sent by Zenoh's."""

import time
from collections.abc import Callable
from typing import Final

from farm.net import codec
from farm.net.telemetry import RunStatus

_PERIOD: Final = 0.5  # [s] at least between two updates
# Largest share of the learner's time for these: with a thousand workers one takes long
_PART: Final = 0.02


class StatusAnswer:
    """A run's state as bytes, which another thread may read at any time."""

    def __init__(self) -> None:
        self.payload = b""
        self._due = 0.0

    @property
    def due(self) -> bool:
        """Whether the answer is old enough to be made anew."""
        return time.monotonic() >= self._due

    def make(self, status: Callable[[], RunStatus]) -> None:
        """Make it anew."""
        start = time.monotonic()
        self.payload = codec.encode(status())
        now = time.monotonic()
        self._due = max(start + _PERIOD, now + (now - start) / _PART)
