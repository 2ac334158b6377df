"""Where messages go: to the terminal, and to a run's log file."""

import logging
import sys
from pathlib import Path
from typing import Final

from farm.errors import ConfigError

LEVELS: Final = ("DEBUG", "INFO", "WARNING", "ERROR")
_FORMAT: Final = "%(asctime)s %(levelname)s %(name)s: %(message)s"


def set_up(level: str) -> None:
    """Messages of that level and above to standard error.

    Raises:
      ConfigError: there is no such level.
    """
    if level.upper() not in LEVELS:
        raise ConfigError(f"unknown log level {level!r}; known are {', '.join(LEVELS)}")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.setLevel(level.upper())
    logging.basicConfig(level=min(logging.INFO, logging.getLevelName(level.upper())), handlers=[handler], force=True)


def also_to(path: Path) -> logging.Handler:
    """Everything from INFO on into a file as well; close the handler at the end."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter(_FORMAT))
    logging.getLogger().addHandler(handler)
    return handler
