"""Command lines made from configuration dataclasses; the only door to tyro."""

import contextlib
import io
import sys
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from farm.errors import ConfigError

C = TypeVar("C")

_FRAME = "│╭╮╰╯─ \n"


def parse(kind: type[C], arguments: Sequence[str], program: str, default: C | None = None) -> C:
    """The dataclass that these arguments say; flags of nested dataclasses have no prefix.

    `--help` prints and exits with status 0.

    Raises:
      ConfigError: an unknown flag, or a value of the wrong type, in one line.
    """
    said = io.StringIO()
    extra: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(said):
            style = (tyro.conf.OmitArgPrefixes, tyro.conf.UseAppendAction)
            return tyro.cli(kind, prog=program, args=arguments, config=style, **extra)
    except SystemExit as end:
        if end.code:
            raise ConfigError(_one_line(said.getvalue(), program)) from None
        sys.stderr.write(said.getvalue())
        raise


def _one_line(box: str, program: str) -> str:
    """What a box of tyro's says, without frame and repetition."""
    body = [line.strip(_FRAME) for line in box.splitlines()[1:]]
    first = next((i for i, line in enumerate(body) if not line), len(body))
    said = " ".join(body[:first]).strip() or "these arguments make no sense"
    hints = [body[i + 1] for i, line in enumerate(body[:-1]) if line.startswith("Perhaps you meant")]
    hint = f"; did you mean {hints[0]}?" if hints else ""
    return f"{said[0].lower()}{said[1:].rstrip('.')}{hint} (see {program} --help)"
