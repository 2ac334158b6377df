"""What a logger is, and a run's loggers together: what goes wrong in one never reaches the learning."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

from farm import plugins
from farm.errors import ConfigError, brief
from farm.net.stats import GenerationStats

log = logging.getLogger(__name__)


class Logger(Protocol):
    """Takes a run's figures to another tool."""

    def __init__(self, folder: Path, config: Mapping[str, Any], done: int) -> None:
        """Begin or continue a run's log.

        Args:
          folder: of the run; its name is the run's.
          config: the resolved configuration, as in config.json.
          done: generations that were logged before; what a killed learner logged beyond them comes again.
        """

    def generation(self, figures: Mapping[str, float]) -> None:
        """Log a generation that is over: the numbers of its line in progress.jsonl, by their names there."""

    def end(self, summary: Mapping[str, Any]) -> None:
        """Log what came out, as in summary.json, and close; called once, however the run ended."""


class Loggers:
    """Those of a run, in their order."""

    def __init__(self, names: Sequence[str], folder: Path, config: Mapping[str, Any], done: int) -> None:
        """Begin all of them.

        Raises:
          ConfigError: there is none of a name, or it cannot begin, as without the package that it needs.
        """
        self._open: dict[str, Logger] = {}
        try:
            for name in dict.fromkeys(names):
                self._open[name] = _begun(name, folder, config, done)
        except ConfigError:
            self.end({})
            raise

    def generation(self, stats: GenerationStats) -> None:
        """Log a generation; what is unknown of it is left out."""
        figures = {name: float(value) for name, value in asdict(stats).items() if value is not None}
        for name in list(self._open):
            self._call(name, "generation", figures)

    def end(self, summary: Mapping[str, Any]) -> None:
        """Log what came out, and close."""
        for name in list(self._open):
            self._call(name, "end", summary)
        self._open.clear()

    def _call(self, name: str, method: str, values: Mapping[str, Any]) -> None:
        try:
            getattr(self._open[name], method)(values)
        except Exception as error:  # whatever another's tool may raise
            del self._open[name]
            log.error("--log %s ends here, learning continues: %s: %s", name, type(error).__name__, brief(str(error)))


def _begun(name: str, folder: Path, config: Mapping[str, Any], done: int) -> Logger:
    target = plugins.find("loggers", name).target
    if missing := [each for each in ("generation", "end") if not hasattr(target, each)]:
        raise ConfigError(f"--log {name}: it is no logger: it has no {' and no '.join(missing)}")
    try:
        logger: Logger = target(folder, config, done)
    except ImportError as error:
        raise ConfigError(f"--log {name} needs {error.name}: pip install {error.name}") from None
    except Exception as error:  # such as no account, or no network
        raise ConfigError(f"--log {name} cannot begin: {type(error).__name__}: {brief(str(error))}") from None
    return logger
