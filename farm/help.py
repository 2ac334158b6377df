"""The help of a command: its flags and their short forms, the usual ones or all."""

import contextlib
import dataclasses
import io
import re
import sys
from collections.abc import Collection
from functools import partial
from typing import Annotated, Any, Final, Literal, get_args, get_origin, get_type_hints

from farm import flags

_NO_DEFAULT: Final = re.compile(r"\(default:[\s│]+(None|False|''|)\)")
_ON: Final = re.compile(r"\(default:([\s│]+)True\)( {0,3})")
_VALUE_OF_SHORT: Final = re.compile(r"(?<=[ │])(-\w) (\S+), (--\S+) \2(?=\s)")
_TITLE: Final = re.compile(
    r"^(╭─| )( ?)(?:[\w-]+\.)*([\w-]+?)(?:-config)? options ([─ ]*)", re.MULTILINE
)
_OR_NONE: Final = re.compile(r"\{None\}\|(\S+)|\{None,(\S+)")


def page(kind: type, default: Any, program: str, usual: Collection[str] | None) -> str:  # noqa: ANN401
    """The help of a command, as wide as the terminal.

    Args:
      kind: its settings, a dataclass.
      default: an instance with the values that are shown, or the dataclass itself.
      program: the command.
      usual: names of the settings that are shown; None: all of them.
    """
    import tyro  # only commands need it

    shown = _dressed(kind, default, usual)
    # Tyro reads its encoding
    output = io.TextIOWrapper(io.BytesIO(), encoding=sys.stdout.encoding or "utf-8")
    with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
        tyro.cli(
            shown.kind, default=shown.default, prog=program, args=["--help"], config=style()[:-1]
        )
    output.seek(0)
    text = _plain(output.read())
    more = f"{program} --help-all shows {shown.hidden} more.\n"
    return text + (more if shown.hidden else "")


def style() -> tuple[Any, ...]:
    """How dataclasses become flags, for Tyro."""
    from tyro import conf

    return (conf.OmitArgPrefixes, conf.UseAppendAction, conf.FlagCreatePairsOff)


@dataclasses.dataclass(frozen=True)
class _Shown:
    """Settings for a help alone: nothing in them is checked."""

    kind: type
    """A subclass of the settings with the short forms."""
    default: Any
    """An instance of it."""
    visible: int
    """Number of settings that are shown."""
    hidden: int
    """Number of the others."""


def _dressed(
    kind: type,
    default: Any,  # noqa: ANN401
    usual: Collection[str] | None,
) -> _Shown:
    """Settings for a help: with the short forms, and without settings that are not shown.

    Args:
      kind: a dataclass.
      default: an instance of it, or itself.
      usual: as in `page`.
    """
    import tyro
    from tyro import conf

    [_, positional] = get_args(conf.Positional[int])
    hints = get_type_hints(kind, include_extras=True)
    fields: list[tuple[str, Any]] = []
    values: dict[str, Any] = {}
    count = 0
    rest = 0
    for each in dataclasses.fields(kind):
        hint = hints[each.name]
        value = flags.default(default, each)
        value = tyro.MISSING if value is dataclasses.MISSING else value
        if dataclasses.is_dataclass(value):
            inner = value if isinstance(value, type) else type(value)
            part = _dressed(inner, value, usual)
            value = part.default
            hint = part.kind if part.visible else conf.Suppress[part.kind]
            count += part.visible
            rest += part.hidden
        elif usual is not None and each.name not in usual:
            hint = conf.Suppress[hint]
            rest += 1
        else:
            count += 1
            if value is not True:  # a switch that is on has both forms, which its text fits
                hint = conf.FlagCreatePairsOff[hint]
            if positional in get_args(hint):
                hint = _called(hint, each.name, optional=value is not tyro.MISSING)
            elif each.name in flags.SHORT:
                hint = Annotated[hint, conf.arg(aliases=(flags.SHORT[each.name],))]
        values[each.name] = value
        fields.append((each.name, hint))
    subclass = dataclasses.make_dataclass(
        kind.__name__,
        fields,
        bases=(kind,),
        frozen=True,
        kw_only=True,
        namespace={"__doc__": kind.__doc__, "__post_init__": lambda _: None},
    )
    return _Shown(subclass, subclass(**values), count, rest)


def _called(hint: Any, name: str, *, optional: bool) -> Any:  # noqa: ANN401  types
    """The type of words without a flag, which the help calls by their setting's name: RUN [RUN ...]
    for `runs`, [DIR] for a `dir` with a default; choices stay as they are.
    """
    from tyro import conf

    of = get_origin(get_args(hint)[0])
    if of is Literal:
        return hint
    word = name.removesuffix("s").upper() if of is tuple else name.upper()
    what = f"{word} [{word} ...]" if of is tuple else f"[{word}]" if optional else word
    return Annotated[hint, conf.arg(metavar=what)]


def _plain(text: str) -> str:
    """Tyro's help as people read it; its columns stay aligned.

    A frame has the last name of its settings as its title, "task" for "run.task-config". Without
    "None" and "False" as a default, "None" as a choice, empty lines in a frame, and the
    value of a short form; "on by default" for switches that are on, which have both forms.
    """
    text = re.sub(_TITLE, _title, text)
    lines = re.sub(_NO_DEFAULT, _blank, re.sub(_ON, _on, text)).splitlines(keepends=True)
    return "".join(
        re.sub(_OR_NONE, partial(_choices, line[0]), re.sub(_VALUE_OF_SHORT, _once, line))
        for line in lines
        if line[0] != "│" or line.strip("│ \n")
    )


def _title(match: re.Match[str]) -> str:
    title = f"{match[1]}{match[2]}{match[3]} options "
    return title + match[4][:1] * (len(match[0]) - len(title))


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\s│]", " ", match[0])


def _on(match: re.Match[str]) -> str:
    if match[1] == " ":
        return f"(on by default){match[2]}"
    return f"(on by   {match[1]}default){match[2][3:]}"


def _once(match: re.Match[str]) -> str:
    return f"{match[1]}, {match[3]} {match[2]}".ljust(len(match[0]))


def _choices(edge: str, match: re.Match[str]) -> str:
    what = match[1] or "{" + match[2]
    return what.ljust(len(match[0])) if edge in " │" else what
