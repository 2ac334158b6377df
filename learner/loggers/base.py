"""The base class of loggers, and all loggers of a run together: their errors never affect
learning.
"""

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
    """Sends a run's figures to another tool."""

    def __init__(self, folder: Path, config: Mapping[str, Any], done: int) -> None:
        """Start or continue a run's log.

        Args:
          folder: of the run; its name is the run's.
          config: the resolved configuration, as in config.json.
          done: generations that were logged before; later ones, logged by a killed learner, are
              logged again.
        """

    def generation(self, figures: Mapping[str, float]) -> None:
        """Log a finished generation: the numbers of its line in progress.jsonl by name."""

    def end(self, summary: Mapping[str, Any]) -> None:
        """Log the results in summary.json, and close; called once, however the run ended."""


class Loggers:
    """The loggers of a run, in order."""

    def __init__(
        self, names: Sequence[str], folder: Path, config: Mapping[str, Any], done: int
    ) -> None:
        """Begin all of them.

        Raises:
          ConfigError: there is none of a name, or it cannot begin, as without the package that it
              needs.
        """
        self._open: dict[str, Logger] = {}
        try:
            for name in dict.fromkeys(names):
                self._open[name] = _begun(name, folder, config, done)
        except ConfigError:
            self.end({})
            raise

    def generation(self, stats: GenerationStats) -> None:
        """Log a generation, without unknown values."""
        if not self._open:
            return
        values = asdict(stats)
        for kind in ("measures", "mean_policy_measures"):
            values |= {f"{kind}_{name}": value for name, value in values.pop(kind).items()}
        figures = {name: float(value) for name, value in values.items() if value is not None}
        for name in list(self._open):
            self._call(name, "generation", figures)

    def end(self, summary: Mapping[str, Any]) -> None:
        """Log the results, and close."""
        for name in list(self._open):
            self._call(name, "end", summary)
        self._open.clear()

    def _call(self, name: str, method: str, values: Mapping[str, Any]) -> None:
        try:
            getattr(self._open[name], method)(values)
        except Exception as error:  # another tool may raise anything
            del self._open[name]
            log.error(
                "--log %s ends here, learning continues: %s: %s",
                name,
                type(error).__name__,
                brief(str(error)),
            )


def _begun(name: str, folder: Path, config: Mapping[str, Any], done: int) -> Logger:
    target = plugins.find("loggers", name).target
    if missing := [each for each in ("generation", "end") if not hasattr(target, each)]:
        raise ConfigError(f"--log {name}: it is no logger: it has no {' and no '.join(missing)}")
    try:
        logger: Logger = target(folder, config, done)
    except ImportError as error:
        raise ConfigError(f"--log {name} needs {error.name}: pip install {error.name}") from None
    except Exception as error:  # for example without an account or a network
        raise ConfigError(
            f"--log {name} cannot begin: {type(error).__name__}: {brief(str(error))}"
        ) from None
    return logger
