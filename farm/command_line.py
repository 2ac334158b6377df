"""Words of a command line become settings, by tyro.

Apart from `farm.settings`, which every policy imports: no number depends on how flags are read, and
their help may change while a run goes on.
"""

import contextlib
import copy
import dataclasses
import io
import re
import sys
from collections.abc import Collection, Sequence
from typing import Any, Final

from farm import flags
from farm import help as pages
from farm.errors import ConfigError
from farm.settings import C, Texts, flag, hints

_WRONG: Final = r"^Error parsing (\S+): (?:{}).*?('[^']*')\]?\.?$"
_PLAINLY: Final = (
    (_WRONG.format("invalid literal for int|no type .*INT"), r"\1 \2: expected a whole number"),
    (_WRONG.format("could not convert|no type .*FLOAT"), r"\1 \2: expected a number"),
    (r"^(Missing value for argument \S+)\. Expected 1 values\.?$", r"\1"),
    (r"^Unrecognized options: ", "Unexpected: "),  # they may be values, or words without a flag
    (r"\.? \(required\)$", ""),
)
"""Sentences of Tyro, and what is said instead."""
_FRAME: Final = "│╭╮╰╯─ \n"


def parse(
    kind: type[C],
    arguments: Sequence[str],
    program: str,
    default: C | None = None,
    *,
    usual: Collection[str] | None = None,
) -> C:
    """Parse arguments into a dataclass; flags of nested dataclasses have no prefix, flags of tuples
    are repeatable.

    `--help` prints the help and exits with status 0; `--help-all` prints the help with all flags.

    Args:
      kind: the dataclass.
      arguments: words of the command line.
      program: the command, for messages.
      default: the values of flags that are not given; None: the dataclass's own.
      usual: names of the settings that `--help` shows; None: all of them.

    Raises:
      ConfigError: an unknown flag, or a value of the wrong type; the message is one line.
    """
    distinct(default, program)
    words = flags.long(arguments)
    if requests := [word for word in words if word in flags.HELP]:
        values = kind if default is None else _emptied(default, ())
        text = pages.page(kind, values, program, None if "--help-all" in requests else usual)
        coding = sys.stdout.encoding or "utf-8"
        sys.stdout.write(text.encode(coding, "replace").decode(coding))
        raise SystemExit(0)
    import tyro  # a help does without it
    from tyro import conf

    words = flags.switched(words, kind if default is None else default, program)
    errors = io.StringIO()
    output = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # Tyro reads its encoding
    style = (conf.OmitArgPrefixes, conf.UseAppendAction, conf.FlagCreatePairsOff)
    extra: dict[str, Any] = {} if default is None else {"default": _emptied(default, words)}
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(output):
            return tyro.cli(kind, prog=program, args=words, config=style, **extra)
    except SystemExit:
        more = "--help" if usual is None else "--help-all"
        raise ConfigError(_one_line(errors.getvalue(), f"{program} {more}")) from None


def _emptied(default: C, arguments: Sequence[str]) -> C:
    """The defaults, with empty tuples for flags that are given: tyro would append to the
    default.
    """
    names = {word.partition("=")[0] for word in arguments}
    out = copy.copy(default)
    for each in dataclasses.fields(default):  # type: ignore[arg-type]
        value = getattr(default, each.name)
        several = isinstance(value, tuple) or (
            isinstance(value, str) and hints(type(default))[each.name] == Texts
        )
        if several and f"--{flag(each.name)}" in names:
            # The default is not checked: the given values replace it
            object.__setattr__(out, each.name, ())
        elif several and isinstance(value, str):
            object.__setattr__(out, each.name, (value,))
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            object.__setattr__(out, each.name, _emptied(value, arguments))
    return out


def distinct(default: Any, program: str) -> None:  # noqa: ANN401  a dataclass of settings, nested ones among them
    """Check that every flag exists only once; a ConfigError if a plug-in's setting has the name
    of another flag.
    """
    owners: dict[str, str] = {}
    waiting = [default] if dataclasses.is_dataclass(default) else []
    while waiting:
        table = waiting.pop(0)
        for each in dataclasses.fields(table):
            value = getattr(table, each.name)
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                waiting.append(value)
            elif owners.setdefault(each.name, type(table).__qualname__) != type(table).__qualname__:
                raise ConfigError(
                    f"--{flag(each.name)} of {program} is also a setting of"
                    f" {type(table).__qualname__}: rename that"
                )


def _one_line(box: str, page: str) -> str:
    """The error text of tyro, without its frame and repetition."""
    body = [line.strip(_FRAME) for line in box.splitlines()[1:]]
    first = next((i for i, line in enumerate(body) if not line), len(body))
    sentence = " ".join(body[:first]).strip() or "these arguments make no sense"
    for pattern, meant in _PLAINLY:
        sentence = re.sub(pattern, meant, sentence)
    hints = [
        body[i + 1] for i, line in enumerate(body[:-1]) if line.startswith("Perhaps you meant")
    ]
    hint = f"; did you mean {hints[0].split()[0]}?" if hints else ""
    return f"{sentence[0].lower()}{sentence[1:].rstrip('.')}{hint} (see {page})"
