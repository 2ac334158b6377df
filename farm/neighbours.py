"""The files of a class: its own, and the neighbours that this names, which travel with it.

A file says which files beside it its code imports, in a line that is read without running it:

    __neighbours__ = ("gaits",)

Then `import gaits` and `from gaits import trot` in these files mean gaits.py in the same folder,
and nowhere else: no module of this name in `sys.modules` is looked at, and none is put there. So
classes of different folders, or of an older and a newer file, do not meet.

Class file and neighbours are one sequence of bytes, the bundle, which has the class's digest:
without neighbours the file's own bytes; otherwise `MAGIC`, a line of JSON with [name, size] of each
file, the class's first and without a name, and their contents.
"""

import ast
import builtins
import hashlib
import importlib.util
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from farm.errors import ConfigError

DECLARED: Final = "__neighbours__"
"""The name in a class's file that says which files beside it belong to it."""

MAGIC: Final = b"\0rolloutfarm files\n"
"""Beginning of a bundle of several files: no Python file begins so."""

MOST: Final = 100
"""Neighbours of a file, and characters of a name, at most."""


def named(path: Path, source: bytes) -> tuple[str, ...]:
    """Names of the modules beside a file that it says it imports; the file is read, not run.

    Raises:
      ConfigError: the line is none that can be read.
    """
    if DECLARED.encode() not in source:
        return ()
    try:
        body = ast.parse(source).body
    except (SyntaxError, ValueError, RecursionError):  # importing it says what is wrong
        return ()
    lines = [each for each in body if isinstance(each, ast.Assign) and _declares(each)]
    if not lines:
        return ()
    where = f"{path}, line {lines[-1].lineno}"
    try:
        names: object = ast.literal_eval(lines[-1].value)
    except ValueError:
        names = None
    if not isinstance(names, tuple | list) or not all(isinstance(each, str) for each in names):
        example = f"{DECLARED} = ('gaits',) for gaits.py beside it"
        raise ConfigError(f"{where}: expected names of modules, such as {example}")
    for name in names:
        if not name.isidentifier() or len(name) > MOST or name == path.stem:
            expected = "expected 'gaits' for gaits.py"
            raise ConfigError(f"{where}: {name[:80]!r} is no other file beside it; {expected}")
    if len(names) > MOST:
        raise ConfigError(f"{where}: {len(names)} neighbours; at most {MOST} travel with a class")
    return tuple(dict.fromkeys(names))


def _declares(line: ast.Assign) -> bool:
    return [each.id for each in line.targets if isinstance(each, ast.Name)] == [DECLARED]


def packed(source: bytes, others: Mapping[str, bytes]) -> bytes:
    """The bundle of a class's file and its neighbours by name."""
    if not others:
        return source
    files = [("", source), *sorted(others.items())]
    head = json.dumps([(name, len(content)) for name, content in files]).encode()
    return MAGIC + head + b"\n" + b"".join(content for _, content in files)


def unpacked(bundle: bytes) -> tuple[bytes, dict[str, bytes]]:
    """A class's file and its neighbours by name; a ValueError if the bytes are no bundle."""
    if not bundle.startswith(MAGIC):
        return bundle, {}
    head, _, content = bundle[len(MAGIC) :].partition(b"\n")
    try:
        table: object = json.loads(head)
    except RecursionError:
        raise ValueError("no bundle of files") from None
    if not isinstance(table, list) or not all(map(_is_entry, table)):
        raise ValueError("no bundle of files")
    names = [name for name, _ in table]
    sizes = [size for _, size in table]
    if (
        len(names) > MOST + 1
        or names[:1] != [""]
        or "" in names[1:]
        or len(set(names)) < len(names)
        or sum(sizes) != len(content)
    ):
        raise ValueError("no bundle of files")
    files = {}
    for name, size in table:
        files[name] = content[:size]
        content = content[size:]
    return files.pop(""), files


def _is_entry(entry: object) -> bool:
    match entry:
        case [str(name), int(size)]:
            valid = not name or (name.isidentifier() and len(name) <= MOST)
            return valid and size >= 0 and type(size) is int
    return False


def paths(path: Path, bundle: bytes) -> list[Path]:
    """The files of a class: its own, and its neighbours."""
    return [path, *(path.with_name(f"{name}.py") for name in unpacked(bundle)[1])]


def imported(path: Path, bundle: bytes, prefix: str) -> ModuleType:
    """The module of a class's file, imported with its neighbours.

    Args:
      path: of the file.
      bundle: its contents, and those of its neighbours.
      prefix: of the modules' names in `sys.modules`, where dataclasses look for their annotations.

    Raises whatever the code raises; no module is left then.
    """
    source, others = unpacked(bundle)
    name = prefix + hashlib.sha256(str(path).encode() + b"\0" + bundle).hexdigest()[:12]
    modules: dict[str, ModuleType] = {}

    def load(full: str, file: Path, content: bytes) -> None:
        spec = importlib.util.spec_from_file_location(full, file)
        assert spec is not None
        module = modules[file.stem] = sys.modules[full] = importlib.util.module_from_spec(spec)
        if others:
            vars(module)["__builtins__"] = {**vars(builtins), "__import__": find}
        try:
            exec(compile(content, str(file), "exec"), vars(module))
        except BaseException:
            del modules[file.stem], sys.modules[full]
            raise

    def find(module: str, *details: Any, **words: Any) -> Any:  # noqa: ANN401  __import__'s
        if module not in others:
            return builtins.__import__(module, *details, **words)
        if module not in modules:
            load(f"{name}_{module}", path.with_name(f"{module}.py"), others[module])
        return modules[module]

    try:
        load(name, path, source)
    except BaseException:
        for each in others:
            sys.modules.pop(f"{name}_{each}", None)
        raise
    return sys.modules[name]
