"""Follows a run over the network: its reports in order, each once, even if either side is offline
for a time.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from farm import plugins
from farm.errors import ConfigError, Interrupted, MessageError, RunError
from farm.net import codec, keys
from farm.net.events import Event
from farm.net.session import Session
from farm.net.telemetry import Report, RunEnd, RunHistory
from farm.sim.model_files import Files, digest, joined
from learner.run import config as configs
from learner.run.config import RunConfig
from learner.run.states import RolledBack

log = logging.getLogger(__name__)

_WAIT: Final = 0.2  # [s] between two checks whether to stop
_ANSWER: Final = 2.0  # [s] for a learner to answer
_FILE: Final = 60.0  # [s] for one of a model's files, up to 32 MiB
_AGAIN: Final = 1.0  # [s] after which a learner that did not answer is asked again
_QUIET: Final = 3.0  # [s] without a report after which the last may have been lost


def find_run(session: Session, farm: str, stopped: Callable[[], bool]) -> str:
    """The name of the only run on a farm; waits for the first.

    Raises:
      ConfigError: there are several.
      Interrupted: it was stopped.
    """
    token, logged = keys.learner_token(farm, "*"), False
    while not stopped():
        runs = sorted(
            keys.run_in(key, keys.learner_token(farm, "")) for key in session.tokens(token, _ANSWER)
        )
        if len(runs) > 1:
            raise ConfigError(
                f"{keys.called(farm)} has several runs: {', '.join(runs)}; choose one with --run"
            )
        if runs:
            return runs[0]
        if not logged:
            log.info("no run on %s yet, waiting for one", keys.called(farm))
            logged = True
        # Queried repeatedly, not watched: for a token just being declared a watch and a query may
        # disagree.
        session.events.waiting(_WAIT)
    raise Interrupted("stopped before there was a run")


class Subscriber:
    """Reads one run's reports as they arrive, and requests missing ones from the learner."""

    def __init__(self, session: Session, farm: str, run: str, files: tuple[Path, ...] = ()) -> None:
        """Subscribe, so that no later report is missed; `files` are those whose classes may be
        used.
        """
        self._files, self._farm = files, farm
        self._session, self._run, self._key = session, run, keys.history(farm, run)
        self._done, self._incarnation = 0, ""
        self._config: RunConfig | None = None
        self.undone = 0
        """Generations that the run had undone when it was first asked."""
        self._ask_at = 0.0
        session.subscribe("report", keys.report(farm, run))
        session.subscribe("history", self._key)
        session.watch("learner", keys.learner_token(farm, run))

    def begin(self, stopped: Callable[[], bool]) -> tuple[str, RunConfig, Files]:
        """The recording's id, the run's configuration and its task's files, as soon as its learner
        answers.

        Raises:
          ConfigError: the configuration is not of this release.
          RunError: the learner has another version.
          Interrupted: it was stopped.
        """
        logged = False
        while not stopped():
            page = self._ask()
            files = None if page is None else self._files_of(page)
            if page is not None and files is not None:
                self._config, self.undone = self._read(page), page.undone
                return page.recording, self._config, files
            if not logged:
                log.info("waiting for the learner of run %s", self._run)
                logged = True
            for event in self._session.events.waiting(_WAIT):
                self._note(event)
        raise Interrupted(f"stopped before run {self._run} was there")

    def _files_of(self, page: RunHistory) -> Files | None:
        """The run's files; None if the learner does not send one."""
        contents: dict[str, bytes] = {}
        for name, expected in page.assets.items():
            content = self._session.ask(keys.asset(self._farm, self._run, expected), _FILE)
            if content is None:
                return None
            if digest(content) != expected:
                raise RunError(
                    f"what the learner of run {self._run} sends as {name} does not match its digest"
                )
            contents[expected] = content
        return joined(page.files, page.assets, contents)

    def follow(self, done: int, stopped: Callable[[], bool]) -> Iterator[Report | RunEnd]:
        """Reports after generation `done` in order, each once; finally the end, when the run is
        over for good.

        Raises:
          RolledBack: the run went back to an earlier generation, because a host was expelled.
          RunError: the run was restarted with other settings, or its learner has another version.
        """
        self._done, self._ask_at = done, 0.0
        while not stopped():
            for event in self._session.events.waiting(
                max(0.001, min(self._ask_at - time.monotonic(), _WAIT))
            ):
                yield from self._take(event)
            if time.monotonic() >= self._ask_at:
                page = self._ask()
                if page is not None:
                    yield from self._page(page)
                    if page.end is not None and self._done >= page.generation:
                        yield page.end
                        return

    def _take(self, event: Event) -> Iterator[Report]:
        if event.topic != "report":
            self._note(event)
            return
        try:
            report = codec.decode(event.payload, Report)
        except MessageError:
            self._ask_at = 0.0  # the history's answer is checked, with an error message
            return
        if report.incarnation != self._incarnation or report.generation > self._done + 1:
            self._ask_at = 0.0
        elif report.generation == self._done + 1:
            self._ask_at = time.monotonic() + _QUIET
            self._done += 1
            yield report

    def _note(self, event: Event) -> None:
        """Handle an event that is not a report: mostly a reason to query the learner."""
        if event.topic == "learner" and not event.alive:
            log.warning("the learner of run %s is gone, waiting for it to come back", self._run)
        elif event.topic in ("learner", "history"):
            self._ask_at = 0.0

    def _ask(self) -> RunHistory | None:
        """The learner's reports after the last known generation, None if it does not answer."""
        payload = self._session.ask(f"{self._key}?from={self._done + 1}", _ANSWER)
        self._ask_at = time.monotonic() + (_AGAIN if payload is None else _QUIET)
        if payload is None:
            return None
        try:
            return codec.decode(payload, RunHistory)
        except MessageError as error:
            raise RunError(
                f"the learner of run {self._run} cannot be understood: {error}"
            ) from None

    def _page(self, page: RunHistory) -> Iterator[Report]:
        if page.incarnation != self._incarnation:
            self._recognise(page)
        if page.generation > self._done:
            self._ask_at = 0.0  # at least one more page, until we are up to date
        if not page.reports:
            self._done = max(self._done, page.generation)  # reports missing in its folder are lost
        for report in page.reports:
            if report.generation > self._done:
                self._done = report.generation
                yield report

    def _recognise(self, page: RunHistory) -> None:
        """Check that a returning learner continues the same run."""
        config = self._read(page)
        if self._config is not None:
            for name, old, new in configs.other(self._config, config):
                raise RunError(
                    f"run {self._run} was started again with --{name} {new} instead of {old}; start"
                    " a new recorder"
                )
        if page.undone > self.undone:
            raise RolledBack(
                f"run {self._run} went back to generation {page.generation}: a host was expelled"
            )
        if self._incarnation:
            log.info(
                "the learner of run %s is back, after generation %d", self._run, page.generation
            )
        self._incarnation = page.incarnation

    def _read(self, page: RunHistory) -> RunConfig:
        """The run's configuration; classes in files are those of this machine's files of the same
        names.

        Raises:
          ConfigError: a class is in none of them.
        """
        check_allowed(page.config, self._files)
        return configs.from_dict(page.config, f"run {self._run}", self._files)


def check_allowed(config: Mapping[str, Any], files: tuple[Path, ...]) -> None:
    """Check that each class in a file comes from one of these files.

    Raises:
      ConfigError: one is in none of them.
    """
    for part in configs.PARTS:
        table = config.get(part)
        name = Path(
            plugins.named_file(str(table.get("name")) if isinstance(table, dict) else "")
        ).name
        if name and name not in [file.name for file in files]:
            raise ConfigError(
                f"the run's {part} is a class in {name}: copy it here, and give --allow-file {name}"
            )
