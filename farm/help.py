"""The help of a command: its flags and their short forms, the usual ones or all.

Written here and not by tyro, whose import and parser take longer than everything else that a help
needs.
"""

import ast
import dataclasses
import enum
import functools
import inspect
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterator
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from farm import flags
from farm.settings import flag

_COLUMN: Final = 26  # where texts begin
_NARROWEST: Final = 48


@dataclasses.dataclass(frozen=True)
class _Group:
    """Settings of one dataclass that are shown together."""

    title: str
    """Empty for the command's own."""
    text: str
    words: tuple[tuple[str, str], ...]
    """Words without a flag: what they are called in the usage, and their texts."""
    flags: tuple[tuple[str, str], ...]
    """Forms of flags, and their texts."""
    hidden: int
    """Number of settings that are not shown."""


def page(kind: type, default: Any, program: str, usual: Collection[str] | None) -> str:  # noqa: ANN401
    """The help of a command, as wide as the terminal.

    Args:
      kind: its settings, a dataclass.
      default: an instance with the values that are shown, or the dataclass itself.
      program: the command.
      usual: names of the settings that are shown; None: all of them.
    """
    groups = list(_groups(kind, default, usual))
    words = [word for group in groups for word in group.words]
    usage = " ".join([f"usage: {program} [-h] [FLAGS]", *(name for name, _ in words)])
    lines = [usage, "", *_paragraphs(_documented(kind)), ""]
    lines += _table([(name.split()[0].strip("[]"), text) for name, text in words])
    lines += [""] if words else []
    first, *inner = groups
    rows = (("-h, --help", "Show this help and exit."), *first.flags)
    for group in (dataclasses.replace(first, flags=rows), *inner):
        lines += _section(group)
    if hidden := sum(group.hidden for group in groups):
        lines += [f"{program} --help-all shows {hidden} more.", ""]
    return "\n".join(lines)


def table(kind: type) -> str:
    """The flags of a dataclass of settings, as a command's help shows them."""
    return "\n".join(line for group in _groups(kind, kind, None) for line in _section(group))


def _section(group: _Group) -> list[str]:
    """A group's title and flags as lines; none without flags."""
    if not group.flags:
        return []
    title = f"{group.title} flags: {group.text}" if group.title else "flags:"
    return [*textwrap.wrap(title, _width()), *_table(group.flags), ""]


def _width() -> int:
    return max(shutil.get_terminal_size().columns, _NARROWEST)


def _groups(
    kind: type,
    default: Any,  # noqa: ANN401
    usual: Collection[str] | None,
    title: str = "",
    text: str = "",
) -> Iterator[_Group]:
    """A dataclass's own settings, then those of the dataclasses among its fields.

    Args:
      kind: the dataclass.
      default: an instance of it, or itself.
      usual: as in `page`.
      title: name of the settings.
      text: what they are.
    """
    hints = get_type_hints(kind, include_extras=True)
    words: list[tuple[str, str]] = []
    rows: list[tuple[str, str]] = []
    inner: list[_Group] = []
    hidden = 0
    for each in dataclasses.fields(kind):
        value = flags.default(default, each)
        if value is dataclasses.MISSING and dataclasses.is_dataclass(hints[each.name]):
            value = hints[each.name]
        if dataclasses.is_dataclass(value):
            of = value if isinstance(value, type) else type(value)
            about = _text(kind, each.name) or _documented(of).partition("\n")[0]
            inner += _groups(of, value, usual, flag(each.name).removesuffix("-config"), about)
            continue
        setting = _Setting.of(kind, each.name, hints[each.name], value)
        if setting.word:
            words.append((setting.usage, setting.text))
        elif usual is None or each.name in usual:
            rows.append((setting.forms, setting.text))
        else:
            hidden += 1
    yield _Group(title, text, tuple(words), tuple(rows), hidden)
    yield from inner


@dataclasses.dataclass(frozen=True)
class _Setting:
    """A setting as the command line has it."""

    name: str
    """Of the flag, without dashes."""
    word: bool
    """A word without a flag."""
    hint: Any
    """Its type."""
    default: Any
    """`dataclasses.MISSING`, or tyro's own mark, if it has to be given."""
    about: str
    """Its docstring."""
    what: str = ""
    """What its value is called; empty: as its type."""

    @classmethod
    def of(cls, kind: type, name: str, hint: Any, default: Any) -> "_Setting":  # noqa: ANN401
        """A field of a dataclass: its type with marks of tyro.conf, and its default."""
        called = flag(name)
        word = False
        about = what = ""
        if get_origin(hint) is Annotated:
            from tyro import conf  # only then, because its import takes time

            [_, positional] = get_args(conf.Positional[int])
            hint, *marks = get_args(hint)
            word = positional in marks
            of_tyro: list[Any] = [mark for mark in marks if isinstance(mark, type(conf.arg()))]
            for mark in of_tyro:
                called, about = mark.name or called, mark.help or about
                what = mark.metavar or what
        return cls(called, word, hint, default, about or _text(kind, name), what)

    @property
    def usage(self) -> str:
        """A word without a flag as the usage has it: RUN [RUN ...] for `runs`, [DIR] for a `dir`
        with a default; choices stay as they are.
        """
        if self.what or get_origin(self.hint) is Literal:
            return self.what or _kind(self.hint)
        if get_origin(self.hint) is tuple:
            one = self.name.removesuffix("s").upper()
            return f"{one} [{one} ...]"
        return self.name.upper() if _needed(self.default) else f"[{self.name.upper()}]"

    @property
    def forms(self) -> str:
        """The flag with its short form and the kind of its value; a switch that is on has both
        forms, which its text fits.
        """
        long = f"--{self.name}"
        if self.default is True:
            return f"{long}, --no-{self.name}"
        short = flags.SHORT.get(self.name)
        both = f"{short}, {long}" if short else long
        switch = self.hint is bool and self.default is False
        return both if switch else f"{both} {self.what or _kind(self.hint)}"

    @property
    def text(self) -> str:
        """What it is, and its default if that says something."""
        default = self.default
        if default is True:
            return f"{self.about} (on by default)".strip()
        if default is None or default is False or _needed(default):
            return self.about
        several = isinstance(default, (tuple, list))
        value = " ".join(map(_shown, default)) if several else _shown(default)
        return f"{self.about} (default: {value})".strip() if value else self.about


def _needed(default: object) -> bool:
    """Whether a setting without this default has to be given."""
    tyro = sys.modules.get("tyro")
    return default is dataclasses.MISSING or (tyro is not None and default is tyro.MISSING)


def _shown(value: object) -> str:
    return value.name if isinstance(value, enum.Enum) else str(value)


def _kind(hint: Any) -> str:  # noqa: ANN401  a type
    """What a flag's value is, as INT or {a,b}."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if origin in (Union, UnionType):
        return "|".join(dict.fromkeys(_kind(part) for part in parts if part is not NoneType))
    if origin is Annotated:
        return _kind(parts[0])
    if parts:  # a tuple, or other values of some kind
        one = [part for part in parts if part is not Ellipsis]
        return " ".join(map(_kind, one if origin is tuple else one[:1]))
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return "{" + ",".join(hint.__members__) + "}"
    return "PATH" if hint is Path else str(getattr(hint, "__name__", hint)).upper()


def _documented(kind: type) -> str:
    """A dataclass's docstring; empty if it is what Python makes of its fields."""
    text = inspect.cleandoc(kind.__doc__ or "")
    return "" if text.startswith(f"{kind.__name__}(") else text


def _text(kind: type, name: str) -> str:
    """The docstring of a field, in one line; empty without one."""
    for each in kind.__mro__:
        module = sys.modules.get(each.__module__) if dataclasses.is_dataclass(each) else None
        text = _texts(module).get((each.__qualname__, name)) if module else None
        if text:
            return text
    return ""


@functools.cache
def _texts(module: ModuleType) -> dict[tuple[str, str], str]:
    """Docstrings of fields by their classes' qualified names and their own."""
    try:
        tree = ast.parse(inspect.getsource(module))
    except (OSError, TypeError, SyntaxError):  # no source
        return {}
    return {
        (where, before.target.id): " ".join(inspect.cleandoc(after.value.value).split())
        for where, body in _classes(tree, "")
        for before, after in zip(body, body[1:], strict=False)
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name)
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(after.value.value, str)
    }


def _classes(node: ast.AST, where: str) -> Iterator[tuple[str, list[ast.stmt]]]:
    """Qualified names and bodies of the classes in a part of a module."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            yield where + child.name, child.body
            yield from _classes(child, f"{where}{child.name}.")
        elif isinstance(child, ast.FunctionDef):
            yield from _classes(child, f"{where}{child.name}.<locals>.")
        elif isinstance(child, ast.stmt):
            yield from _classes(child, where)


def _paragraphs(text: str) -> list[str]:
    """A docstring's paragraphs as lines, with empty ones between them."""
    lines: list[str] = []
    for paragraph in text.split("\n\n"):
        lines += [*([""] if lines else []), *textwrap.wrap(paragraph, _width())]
    return lines


def _table(rows: Collection[tuple[str, str]]) -> list[str]:
    """Names and their texts in two columns; a long name has a line of its own."""
    lines: list[str] = []
    width = _width()
    for name, text in rows:
        first = f"  {name}"
        if len(first) > _COLUMN - 2:
            lines += textwrap.wrap(first, width, subsequent_indent="    ")
            first = ""
        texts = textwrap.wrap(text, width - _COLUMN, break_on_hyphens=False)
        lines += [(first if i == 0 else "").ljust(_COLUMN) + line for i, line in enumerate(texts)]
        lines += [first] if first and not texts else []
    return lines
