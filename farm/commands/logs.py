"""Messages on the terminal."""

import logging
import sys
from typing import Final

from farm.errors import ConfigError

LEVELS: Final = ("DEBUG", "INFO", "WARNING", "ERROR")


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
