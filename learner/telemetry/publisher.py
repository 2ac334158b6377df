"""Publishes a run for viewers over the network: every generation as it ends, and earlier ones on
request.
"""

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from farm.net import codec, keys
from farm.net.session import Session
from farm.net.telemetry import Line, Report, RunEnd, RunHistory
from farm.sim.model_files import split
from learner.run import config as configs
from learner.run.files import with_rates
from learner.run.learner import Learner
from learner.telemetry.report_log import ReportLog

log = logging.getLogger(__name__)

LINES: Final = 100
"""Largest number of log lines in a report; the latest are kept."""
LINE: Final = 500
"""Characters of a line."""
_TRACES: Final = 8 << 20  # [bytes]; larger traces of all rollouts stay with the learner
_FAREWELL: Final = 5.0  # [s] for recorders to fetch the end
_LOOK: Final = 0.02  # [s] between two checks whether they have


class Publisher(logging.Handler):
    """Publishes each generation's report without waiting; serves past reports on request.

    A recorder notices missing reports by their generations' numbers, and requests them.
    """

    def __init__(self, session: Session, farm: str, incarnation: str, learner: Learner) -> None:
        """Begin; the run's folder has the earlier generations."""
        super().__init__(logging.INFO)
        self._session, self._key = session, keys.history(farm, learner.folder.name)
        texts, assets = split(learner.problem.task.sources)
        self._run = RunHistory(  # replaced as a whole, because another thread reads it
            run=learner.folder.name,
            incarnation=incarnation,
            recording=learner.run,
            config=configs.to_dict(learner.config),
            files=texts,
            assets=assets,
            generation=learner.state.generation,
            reports=(),
            end=None,
            undone=learner.undone,
        )
        self._folder, self._lines, self._warned = learner.folder, list[Line](), False
        self._reports = ReportLog(self._earlier)
        self._outlet = session.outlet(keys.report(farm, self._run.run))
        session.answer_asked(self._key, self._page)
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Send a log message with the next report."""
        self._lines = [
            *self._lines[1 - LINES :],
            Line(level=record.levelname, text=record.getMessage()[:LINE]),
        ]

    def generation(self, report: Report) -> None:
        """Publish a finished generation."""
        message = replace(
            self._bounded(report), incarnation=self._run.incarnation, lines=self._taken()
        )
        payload = self._reports.add(message)
        self._run = replace(self._run, generation=message.generation)
        if self._outlet.heard:
            self._outlet.publish(payload)

    def end(self, end: RunEnd) -> None:
        """Announce the end of the run."""
        self._run = replace(self._run, end=replace(end, lines=self._taken()))
        self._session.publish(self._key, b"", block=False)

    def _taken(self) -> tuple[Line, ...]:
        self.acquire()  # as logging does around emit
        lines, self._lines = tuple(self._lines), []
        self.release()
        return lines

    def close(self) -> None:
        """Accept no more log messages.

        If the run is over, give recorders a moment to request missing reports.
        """
        until = time.monotonic() + _FAREWELL
        while self._run.end is not None and self._outlet.heard and time.monotonic() < until:
            time.sleep(_LOOK)  # they leave when they have everything
        logging.getLogger().removeHandler(self)
        super().close()

    def _page(self, query: str) -> bytes:
        """Past reports from a generation on: `from=<generation>`. Thread: Zenoh's."""
        digits = query.removeprefix("from=")[:12]
        first = int(digits) if digits.isascii() and digits.isdigit() else 1
        run = self._run  # before the reports, which may grow meanwhile
        return codec.encode(replace(run, reports=self._reports.page(first)))

    def _earlier(self, first: int) -> Iterator[Report]:
        """Published generations in the folder from this one on, without rollouts.

        Thread: Zenoh's.
        """
        last = self._run.generation
        for progress, rate in with_rates(self._folder.progress_after(first - 2)):
            if progress.generation > last:
                return
            if progress.generation >= first:
                yield Report(incarnation=self._run.incarnation, progress=progress, rate=rate)

    def _bounded(self, report: Report) -> Report:
        """The report, without the traces of all rollouts if they are too large for a message."""
        if "all" not in report.traces or report.traces["all"].nbytes <= _TRACES:
            return report
        if not self._warned:
            self._warned = True
            log.warning(
                "traces of all rollouts are too large for recorders elsewhere: they get the best"
                " and the worst"
            )
        traces = {name: values for name, values in report.traces.items() if name != "all"}
        return replace(report, traces=traces)
