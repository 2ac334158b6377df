"""Publishes a run for viewers over the network: every generation as it ends, and earlier ones on request."""

import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

from farm.net import codec, keys
from farm.net.session import Session
from farm.net.stats import GenerationStats
from farm.net.telemetry import Line, RunEnd, RunHistory, RunReport
from farm.net.work import WireTrajectory
from learner import config as configs
from learner.evaluation import Evaluation
from learner.learner import Learner
from learner.telemetry.report import Report, packed, wire
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
        """Start with the earlier generations in the run's folder."""
        super().__init__(logging.INFO)
        self._session, self._key, self._incarnation = session, keys.history(farm, learner.folder.name), incarnation
        self._run, self._recording, self._config = learner.folder.name, learner.run, configs.to_dict(learner.config)
        self._files = dict(learner.problem.task.sources)
        self._history, self._generation = ReportLog(), learner.state.generation
        self._end: RunEnd | None = None
        self._best: tuple[WireTrajectory | None, int] = (None, 0)
        self._lines: list[Line] = []
        self._told = False
        for report in _before(learner.folder.progress(), self._run, incarnation):
            self._history.add(report)
        self._outlet = session.outlet(keys.report(farm, self._run))
        session.answer_asked(self._key, self._page)
        logging.getLogger().addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Send a log message with the next report."""
        self._lines = [*self._lines[1 - LINES :], Line(level=record.levelname, text=record.getMessage()[:LINE])]

    def generation(self, report: Report) -> None:
        """Publish a finished generation."""
        message = packed(self._bounded(report), self._run, self._incarnation, self._taken())
        if message.replay is not None:
            self._best = message.replay, message.replay_generation
        self._history.add(message)
        self._generation = message.generation
        if self._outlet.heard:
            self._outlet.publish(codec.encode(message))

    def end(self, summary: dict[str, Any], evaluation: Evaluation | None, best_generation: int) -> None:
        """Announce the end of the run, and give recorders a moment to request missing reports."""
        best = wire(evaluation.replay) if evaluation else None
        if best is not None:
            self._best = best, best_generation
        self._end = RunEnd(
            summary=summary, lines=self._taken(), best=self._best[0], best_generation=self._best[1],
            mean=wire(evaluation.mean.trajectory) if evaluation else None,
        )  # fmt: skip
        self._session.publish(self._key, b"", block=False)
        until = time.monotonic() + _FAREWELL
        while self._outlet.heard and time.monotonic() < until:  # they leave when they have everything
            time.sleep(_LOOK)

    def close(self) -> None:
        """Accept no more log messages."""
        logging.getLogger().removeHandler(self)
        super().close()

    def _page(self, asked: str) -> bytes:
        """Past reports from a generation on: `from=<generation>`; called on another thread."""
        digits = asked.removeprefix("from=")[:12]
        first = int(digits) if digits.isascii() and digits.isdigit() else 1
        done, end = self._generation, self._end  # before the reports, which may grow meanwhile
        return codec.encode(
            RunHistory(
                run=self._run,
                incarnation=self._incarnation,
                recording=self._recording,
                config=self._config,
                files=self._files,
                generation=done,
                reports=self._history.page(first),
                end=end,
            )  # fmt: skip
        )

    def _taken(self) -> tuple[Line, ...]:
        self.acquire()  # as logging does around emit
        lines, self._lines = tuple(self._lines), []
        self.release()
        return lines

    def _bounded(self, report: Report) -> Report:
        """The report, without the traces of all rollouts if they are too large for a message."""
        if "all" not in report.traces or report.traces["all"].nbytes <= _TRACES:
            return report
        if not self._told:
            self._told = True
            log.warning("traces of all rollouts are too large for recorders elsewhere: they get the best and the worst")
        traces = {name: values for name, values in report.traces.items() if name != "all"}
        return replace(report, traces=traces)


def _before(progress: list[GenerationStats], run: str, incarnation: str) -> Iterator[RunReport]:
    """Reports of the generations in the folder, without rollouts."""
    rollouts, seconds = 0, 0.0
    for p in progress:
        rate = (p.rollouts - rollouts) / max(p.seconds - seconds, 1e-3)  # seconds are written to the millisecond
        rollouts, seconds = p.rollouts, p.seconds
        yield RunReport(run=run, incarnation=incarnation, generation=p.generation, progress=p.to_dict(), rate=rate)
