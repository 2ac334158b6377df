"""Queries to learners: those that do not answer must not stop a worker's other runs."""

import time
from typing import Final

from farm.net.session import Session

ASK: Final = 1.0
"""Time for an answer [s]."""
_MUTE: Final = 9.0  # after an unanswered query, the next is sent this many times its duration later


class Queries:
    """Asks learners; waiting for missing answers takes at most a tenth of the worker's time."""

    def __init__(self, session: Session) -> None:
        self._session = session
        # No queries before this time [s], by run whose learner is there
        self._mute: dict[str, float] = {}
        self._others = 0.0  # the same for all other runs together

    def came(self, run: str) -> None:
        """A run's learner is there."""
        self._mute.setdefault(run, 0.0)

    def left(self, run: str) -> None:
        """A run's learner is gone."""
        self._mute.pop(run, None)

    def ask(self, run: str, key: str, seconds: float | None = None) -> bytes | None:
        """The answer of a run's learner within a time, ASK by default [s], or None."""
        start = time.monotonic()
        if start < self._mute.get(run, self._others):
            return None
        payload = self._session.ask(key, ASK if seconds is None else seconds)
        if payload is None:
            now = time.monotonic()
            self._others = now + _MUTE * (now - start)
            if run in self._mute:
                self._mute[run] = self._others
        return payload
