"""Who is there: workers whose liveliness token is. Pure: time is an argument, in seconds.

A name alone is cheap: whoever reaches the network can make up as many as he likes. A token belongs to a session and
goes with it, and there are bounds to both.
"""

from itertools import islice
from typing import Final

from farm.errors import MessageError
from farm.net.messages import Want

_MOST: Final = 10_000  # tokens; more workers than a learner feeds
_ASKING: Final = 1000  # that ask before their token came
_SOON: Final = 3.0  # [s] within which it does: token and question take different ways


class Attendance:
    """Tokens, and questions that came ahead of theirs."""

    def __init__(self) -> None:
        self._there: set[str] = set()
        self._early: dict[str, tuple[Want, float]] = {}

    def came(self, worker: str) -> Want | None:
        """A token appeared; return what its worker asked for before.

        Raises:
          MessageError: there are too many.
        """
        if worker not in self._there and len(self._there) >= _MOST:
            raise MessageError(f"{_MOST} workers are there already", "absent")
        self._there.add(worker)
        return self._early.pop(worker, (None, 0.0))[0]

    def early(self, most: int) -> list[str]:
        """Some that have asked and whose token has not come, those of whom that was said longest ago first."""
        names = list(islice(self._early, most))
        for name in names:
            self._early[name] = self._early.pop(name)
        return names

    def left(self, worker: str) -> None:
        """A token is gone."""
        self._there.discard(worker)
        self._early.pop(worker, None)

    def asked(self, want: Want, now: float) -> bool:
        """Say whether who asks is there; what others ask is kept until they are, if that is soon.

        Raises:
          MessageError: too many ask who are not.
        """
        if want.worker in self._there:
            return True
        if want.worker not in self._early and len(self._early) >= _ASKING:
            raise MessageError(f"{_ASKING} others ask whose tokens are not there", "absent")
        self._early[want.worker] = want, self._early.get(want.worker, (want, now))[1]
        return False

    def absent(self, now: float) -> list[str]:
        """Forget who asked and never came; their names."""
        gone = [worker for worker, (_, since) in self._early.items() if now - since > _SOON]
        for worker in gone:
            del self._early[worker]
        return gone
