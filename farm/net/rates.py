"""Which machines send too much. Pure: time is an argument [s]."""

from collections import Counter
from typing import Final

# [s] that messages are counted: a host that wakes up may send many old results at once
_OVER: Final = 3.0
_USUAL: Final = 6  # messages of one worker in that time; a worker asks for work once per second
# Weight of each further one: a slow machine may not take in enough of a flood otherwise
_WEIGHT: Final = 3


class Rates:
    """Counts messages by machine."""

    def __init__(self) -> None:
        self.most = 2000
        """Messages in three seconds that a machine may send."""
        self._since = 0.0
        self._machines, self._workers = Counter[str](), Counter[str]()

    def flooding(self, worker: str, now: float) -> bool:
        """Count a message of a worker, <machine>/<instance>; return whether its machine has sent
        more than `most`.
        """
        if now - self._since >= _OVER:
            self._since = now
            self._machines.clear()
            self._workers.clear()
        machine = worker.partition("/")[0]
        self._workers[worker] += 1
        self._machines[machine] += 1 if self._workers[worker] <= _USUAL else _WEIGHT
        return self._machines[machine] > self.most
