"""A run's past reports, for recorders that join late. Limited in size: old rollouts are dropped, statistics kept."""

import threading
from collections import deque
from dataclasses import replace
from typing import Final

from farm.net import codec
from farm.net.telemetry import Report

MEMORY: Final = 32 << 20
"""Memory limit of rollouts and traces [bytes]; the oldest are dropped first."""

PAGE: Final = 4 << 20
"""A page ends with the report that reaches this size [bytes]."""

_PLAIN: Final = 600  # [bytes] of a report's statistics, approximately


class ReportLog:
    """Reports in order; written by the learner's thread, read by the thread that answers queries."""

    def __init__(self, memory: int = MEMORY, page: int = PAGE) -> None:
        self._memory, self._page = memory, page
        self._reports: list[Report | bytes] = []  # as bytes, statistics take a fifth
        self._whole: deque[int] = deque()  # positions of the reports with rollouts or traces
        self._size = 0
        self._lock = threading.Lock()

    def add(self, report: Report) -> None:
        """Keep the next generation's report, and drop the oldest rollouts if there are too many."""
        with self._lock:
            size = report.nbytes
            self._reports.append(report if size else codec.encode(report))
            if size:
                self._whole.append(len(self._reports) - 1)
                self._size += size
            while self._size > self._memory:
                at = self._whole.popleft()
                oldest = self._at(at)
                self._size -= oldest.nbytes
                self._reports[at] = codec.encode(replace(oldest, traces={}, sample=None, replay=None))

    def page(self, generation: int) -> tuple[Report, ...]:
        """Reports from that generation on, as many as fit into a page; at least one, if there is one.

        Thread: Zenoh's.
        """
        with self._lock:
            reports: list[Report] = []
            size = 0
            for i in range(self._first(generation), len(self._reports)):
                reports.append(self._at(i))
                size += _PLAIN + reports[-1].nbytes
                if size >= self._page:
                    break
            return tuple(reports)

    def _first(self, generation: int) -> int:
        """Position of the first report of this generation or a later one; reports may be missing."""
        at = min(max(generation - 1, 0), len(self._reports))
        while at > 0 and self._at(at - 1).generation >= generation:
            at -= 1
        return at

    def _at(self, i: int) -> Report:
        report = self._reports[i]
        return codec.decode(report, Report) if isinstance(report, bytes) else report
