"""How many messages a machine sends in a second. Pure: time is an argument [s]."""

from collections import Counter


class Rates:
    """Counts a subscription's messages by the machine in their keys, <prefix><machine>/<instance>."""

    def __init__(self, prefix: str, most: int) -> None:
        """`most` per second are what honest workers may send."""
        self._start, self._most = len(prefix), most
        self._since, self._counts = 0.0, Counter[str]()

    def flooding(self, key: str, now: float) -> str | None:
        """Count a message; name its machine if it has sent too many in this second."""
        if now - self._since >= 1.0:
            self._since = now
            self._counts.clear()
        name = key[self._start : key.find("/", self._start)]
        self._counts[name] += 1
        return name if self._counts[name] > self._most else None
