"""A run's past reports, for recorders that join late.

Limited in size: of older ones the folder has the statistics.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from farm.net import codec
from farm.net.telemetry import Report

MEMORY: Final = 32 << 20
"""Memory limit of all reports that are kept [bytes]; the oldest are dropped first."""

PAGE: Final = 4 << 20
"""A page ends with the report that reaches this size [bytes]."""

_EACH: Final = 150  # [bytes] that a report takes beside its own


def _none(_: int) -> Iterable[Report]:
    return ()


class ReportLog:
    """Reports in order, as bytes; written by the learner's thread, read by the thread that
    answers queries.
    """

    def __init__(
        self,
        earlier: Callable[[int], Iterable[Report]] = _none,
        memory: int = MEMORY,
        page: int = PAGE,
    ) -> None:
        """Begin without reports.

        Args:
          earlier: the statistics from a generation on, in order: of reports that are not kept, or
              not any more.
          memory: limit of those that are kept [bytes].
          page: size of a page [bytes].
        """
        self._earlier, self._memory, self._page = earlier, memory, page
        self._kept: deque[tuple[int, bytes]] = deque()  # by generation
        self._size = 0
        self._lock = threading.Lock()

    def add(self, report: Report) -> bytes:
        """Keep the next generation's report, and drop the oldest if there are too many; return
        it as bytes.
        """
        payload = codec.encode(report)
        with self._lock:
            self._kept.append((report.generation, payload))
            self._size += len(payload) + _EACH
            while self._size > self._memory:
                self._size -= len(self._kept.popleft()[1]) + _EACH
        return payload

    def page(self, generation: int) -> tuple[Report, ...]:
        """Reports from that generation on, as many as fit into a page; at least one, if there is
        one.

        Thread: Zenoh's.
        """
        with self._lock:
            recent = [each for each in self._kept if each[0] >= generation]
            first = self._kept[0][0] if self._kept else None
        reports: list[Report] = []
        size = 0
        if first is None or generation < first:
            for report in self._earlier(generation):
                if first is not None and report.generation >= first:
                    break
                reports.append(report)
                size += report.nbytes
                if size >= self._page:
                    return tuple(reports)
        for _, payload in recent:
            reports.append(codec.decode(payload, Report))
            size += len(payload)
            if size >= self._page:
                break
        return tuple(reports)
