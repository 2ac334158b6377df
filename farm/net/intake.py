"""What machines send that should hardly send anything: viewers, who only ask. Pure."""

from collections import Counter
from collections.abc import Mapping
from typing import Final

PERIOD: Final = 1.0
"""Time between two counts [s]."""
FORGIVEN: Final = 10_000
"""Bytes of a machine's that each count takes from its sum; a recorder sends 35 per second."""
MOST: Final = 100_000
"""The largest sum that is no flood [bytes]; a recorder connects with 1.3 kB."""


class Intake:
    """Sums bytes by machine, from what has come over each connection so far.

    What a machine may send in the long run is forgiven, so that a slow flood adds up too: one that
    the receiver itself slows down, because each of its messages costs more than the one before.
    """

    def __init__(self) -> None:
        self._before: Mapping[str, int] = {}
        self._sums = Counter[str]()

    def over(self, received: Mapping[str, int], machines: Mapping[str, str]) -> list[str]:
        """Machines whose sum has passed MOST with this count; their sums begin anew.

        Args:
          received: bytes of each connection so far, by its address.
          machines: the machine at each address.
        """
        for address, machine in machines.items():
            self._sums[machine] += received.get(address, 0) - self._before.get(address, 0)
        self._before = received
        over = sorted(machine for machine, size in self._sums.items() if size > MOST)
        for machine in over:
            del self._sums[machine]
        self._sums = Counter({m: n - FORGIVEN for m, n in self._sums.items() if n > FORGIVEN})
        return over
