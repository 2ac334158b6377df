"""What machines send that should hardly send anything: viewers, who only ask. Pure."""

from collections import Counter
from collections.abc import Mapping
from typing import Final

PERIOD: Final = 1.0
"""Time between two counts [s]."""
MOST: Final = 100_000
"""Bytes of a machine's in that time: some hundred questions; a recorder asks ten times per
second at most.
"""


class Intake:
    """Counts bytes by machine, from what has come over each connection so far."""

    def __init__(self) -> None:
        self._before: Mapping[str, int] = {}

    def over(self, received: Mapping[str, int], machines: Mapping[str, str]) -> list[str]:
        """Machines that sent more than MOST since the last call.

        Args:
          received: bytes of each connection so far, by its address.
          machines: the machine at each address.
        """
        sizes = Counter[str]()
        for address, machine in machines.items():
            sizes[machine] += received.get(address, 0) - self._before.get(address, 0)
        self._before = received
        return sorted(machine for machine, size in sizes.items() if size > MOST)
