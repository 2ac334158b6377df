"""Notices about messages that a process cannot use: counted by kind, each text logged once."""

import logging
from collections import Counter
from typing import Final

from farm.errors import brief

_LATE: Final = ("stale", "doubled")  # answers to jobs that another worker has done meanwhile
_TEXTS: Final = 1000  # different ones that are logged


class Notices:
    """Ignored messages by kind, and a log without repetitions: a hostile sender must not fill
    it.
    """

    def __init__(self, log: logging.Logger) -> None:
        self.ignored: Counter[str] = Counter()
        """Number of ignored messages, by kind: stale, doubled, unasked, foreign, absent, refused,
        bad, large, version, flood.
        """
        self._log, self._texts = log, set[str]()

    def ignore(self, kind: str, text: str) -> None:
        """Count an ignored message, and say which it was, unless it is only late."""
        self.ignored[kind] += 1
        if kind not in _LATE:
            self.once(f"ignored a message {text}")

    def once(
        self,
        text: str,
        traceback: tuple[str, ...] = (),
        *,
        level: int = logging.WARNING,
        error: Exception | None = None,
    ) -> None:
        """Log a text once, with an error's own traceback or one that was sent; of equal ones
        sent, only the first.
        """
        text = brief(text)
        if text in self._texts or len(self._texts) >= _TEXTS:
            return
        self._texts.add(text)
        self._log.log(level, "%s", text, exc_info=error)
        whole = "\n".join(traceback)
        for line in traceback if whole not in self._texts else ():
            self._log.log(level, "  %s", line)
        self._texts.add(whole)
