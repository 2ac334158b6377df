"""Which machines send too much. Pure: time is an argument [s]."""

from collections import Counter
from typing import Final

_OVER: Final = 3.0  # [s] that messages are counted: a host that wakes up may send many old results at once


class Rates:
    """Counts messages by machine."""

    def __init__(self) -> None:
        self.most = 2000
        """Messages in three seconds that a machine may send."""
        self._since, self._counts = 0.0, Counter[str]()

    def flooding(self, name: str, now: float) -> bool:
        """Count a message of a machine; return whether it has sent more than `most` in these seconds."""
        if now - self._since >= _OVER:
            self._since = now
            self._counts.clear()
        self._counts[name] += 1
        return self._counts[name] > self.most
