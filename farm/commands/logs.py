"""Messages on the terminal."""

import logging
import sys
from typing import Any, Final

from farm.errors import ConfigError, printable

LEVELS: Final = ("DEBUG", "INFO", "WARNING", "ERROR")


class Formatter(logging.Formatter):
    """Messages of one line; control characters from the network are escaped."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  logging's name
        """The line; a traceback below it keeps its lines."""
        record.message = printable(record.message)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:  # noqa: ANN401, N802  logging's name and type
        """The traceback."""
        return printable(super().formatException(ei), kept="\n")


def set_up(level: str) -> None:
    """Print messages of that level and above to standard error; a ConfigError if there is no
    such level.
    """
    if level.upper() not in LEVELS:
        raise ConfigError(f"unknown log level {level!r}; known are {', '.join(LEVELS)}")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Formatter("%(message)s"))
    handler.setLevel(level.upper())
    # PyOpenGL, which MuJoCo may import now, tells everybody which accelerator it lacks
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    logging.basicConfig(
        level=min(logging.INFO, logging.getLevelName(level.upper())), handlers=[handler], force=True
    )


def say(*lines: str) -> None:
    """Write lines to standard output, at once even if it is a pipe; control characters are escaped.

    A name in them may come from a task, a folder or another machine.
    """
    sys.stdout.write("".join(printable(line, kept="\n") + "\n" for line in lines))
    sys.stdout.flush()
