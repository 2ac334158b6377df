"""The help of a command: its flags and their short forms, the usual ones or all.

Written here and not by tyro, whose import and parser take longer than everything else that a help
needs.
"""

import ast
import dataclasses
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
    width = max(shutil.get_terminal_size().columns, _NARROWEST)
    groups = list(_groups(kind, default, usual))
    words = [word for group in groups for word in group.words]
    usage = " ".join([f"usage: {program} [-h] [FLAGS]", *(name for name, _ in words)])
    lines = [usage, "", *_paragraphs(kind.__doc__ or "", width), ""]
    lines += _table([(name.split()[0].strip("[]"), text) for name, text in words], width)
    lines += [""] if words else []
    for group in groups:
        shown = group.flags
        if not group.title:
            shown = (("-h, --help", "Show this help and exit."), *shown)
        if shown:
            title = f"{group.title} flags: {group.text}" if group.title else "flags:"
            lines += [*textwrap.wrap(title, width), *_table(shown, width), ""]
    if hidden := sum(group.hidden for group in groups):
        lines += [f"{program} --help-all shows {hidden} more.", ""]
    return "\n".join(lines)


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
    shown: list[tuple[str, str]] = []
    inner: list[_Group] = []
    hidden = 0
    for each in dataclasses.fields(kind):
        value = flags.default(default, each)
        if dataclasses.is_dataclass(value):
            of = value if isinstance(value, type) else type(value)
            about = _text(kind, each.name) or inspect.cleandoc(of.__doc__ or "").partition("\n")[0]
            inner += _groups(of, value, usual, flag(each.name).removesuffix("-config"), about)
            continue
        setting = _Setting.of(kind, each.name, hints[each.name], value)
        if setting.word:
            words.append((setting.usage, setting.text))
        elif usual is None or each.name in usual:
            shown.append((setting.forms, setting.text))
        else:
            hidden += 1
    yield _Group(title, text, tuple(words), tuple(shown), hidden)
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

    @classmethod
    def of(cls, kind: type, name: str, hint: Any, default: Any) -> "_Setting":  # noqa: ANN401
        """A field of a dataclass: its type with marks of tyro.conf, and its default."""
        called, word, about = flag(name), False, ""
        if get_origin(hint) is Annotated:
            from tyro import conf  # only then, because its import takes time

            [_, positional] = get_args(conf.Positional[int])
            hint, *marks = get_args(hint)
            word = positional in marks
            for mark in marks:
                called = getattr(mark, "name", None) or called
                about = getattr(mark, "help", None) or about
        return cls(called, word, hint, default, about or _text(kind, name))

    @property
    def usage(self) -> str:
        """A word without a flag as the usage has it: RUN [RUN ...] for `runs`, [DIR] for a `dir`
        with a default; choices stay as they are.
        """
        if get_origin(self.hint) is Literal:
            return _kind(self.hint)
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
        named = f"{short}, {long}" if short else long
        return named if self.hint is bool else f"{named} {_kind(self.hint)}"

    @property
    def text(self) -> str:
        """What it is, and its default if that says something."""
        if self.default is True:
            return f"{self.about} (on by default)"
        several = isinstance(self.default, tuple)
        value = " ".join(map(str, self.default)) if several else str(self.default)
        silent = self.default is None or self.default is False or _needed(self.default)
        return self.about if silent or not value else f"{self.about} (default: {value})"


def _needed(default: object) -> bool:
    """Whether a setting without this default has to be given."""
    tyro = sys.modules.get("tyro")
    return default is dataclasses.MISSING or (tyro is not None and default is tyro.MISSING)


def _kind(hint: Any) -> str:  # noqa: ANN401  a type
    """What a flag's value is, as INT or {a,b}."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated or origin is tuple:
        return _kind(parts[0])
    if origin is Literal:
        return "{" + ",".join(map(str, parts)) + "}"
    if origin in (Union, UnionType):
        return "|".join(dict.fromkeys(_kind(part) for part in parts if part is not NoneType))
    return "PATH" if hint is Path else str(hint.__name__).upper()


def _text(kind: type, name: str) -> str:
    """The docstring of a field, in one line; empty without one."""
    for each in kind.__mro__:
        if name in each.__dict__.get("__annotations__", {}):
            module = sys.modules.get(each.__module__)
            found = _texts(module) if module else {}
            if text := found.get((each.__qualname__, name)):
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


def _paragraphs(text: str, width: int) -> list[str]:
    """A docstring's paragraphs as lines, with empty ones between them."""
    lines: list[str] = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        lines += [*([""] if lines else []), *textwrap.wrap(paragraph, width)]
    return lines


def _table(rows: Collection[tuple[str, str]], width: int) -> list[str]:
    """Names and their texts in two columns; a long name has a line of its own."""
    lines: list[str] = []
    for name, text in rows:
        first = f"  {name}"
        if len(first) > _COLUMN - 2:
            lines += textwrap.wrap(first, width, subsequent_indent="    ")
            first = ""
        texts = textwrap.wrap(text, width - _COLUMN, break_on_hyphens=False)
        lines += [(first if i == 0 else "").ljust(_COLUMN) + line for i, line in enumerate(texts)]
        lines += [first] if first and not texts else []
    return lines
