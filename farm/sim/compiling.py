"""Compiling a model where MuJoCo has only the files that it is given: in a process, within
limits.
"""

import importlib.util
import os
import posixpath
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

from farm.errors import ConfigError, brief
from farm.sim import compiler

SECONDS: Final = 40
"""Longest time that a model may take to compile [s]."""

MEMORY: Final = 4 << 30
"""Most memory that this may take, with one state of the simulation [bytes]."""

_FOLDER: Final = re.compile(rf"{compiler.ABOVE}/[^'\"\n]*")

Get: TypeAlias = Callable[[str], bytes | None]
"""A file's content, by its path in the model's folder; None if it has none.

A path outside of this folder begins with .. or /.
"""


@dataclass(frozen=True)
class Compiled:
    """A compiled model."""

    binary: bytes
    """MuJoCo's binary file (MJB)."""
    paths: tuple[str, ...]
    """The files that MuJoCo has read, the model first."""


class RefusedError(ConfigError):
    """MuJoCo does not compile a model; the message is MuJoCo's."""

    def __init__(self, message: str, missing: tuple[str, ...] = ()) -> None:
        """Take MuJoCo's message, and the files that it has looked for in vain."""
        super().__init__(message)
        self.missing = missing


def compile_model(main: str, get: Get) -> Compiled:
    """Compile the model with this path; `get` is the only source of its files.

    Raises:
      RefusedError: MuJoCo refuses it, or it takes too much time or memory.
    """
    paths: list[str] = []
    missing: list[str] = []
    with _started(main) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            while (message := compiler.receive(process.stdout))[0] == compiler.ASKED:
                path = _relative(os.fsdecode(message[1]))
                content = get(path)
                (missing if content is None else paths).append(path)
                if content is None:
                    compiler.send(process.stdin, compiler.MISSING)
                else:
                    compiler.send(process.stdin, compiler.FOUND, content)
        except (EOFError, BrokenPipeError):
            raise RefusedError(_ended(process.wait())) from None
        finally:
            process.kill()
            with suppress(BrokenPipeError):
                process.stdin.close()
    kind, content = message
    if kind != compiler.COMPILED:
        error = _FOLDER.sub(lambda match: _relative(match[0]), content.decode(errors="replace"))
        raise RefusedError(_with_limit(brief(error)), tuple(missing))
    return Compiled(content, tuple(dict.fromkeys(paths)))


def _relative(path: str) -> str:
    """A path as seen from the model's folder, if it is one of the folder that MuJoCo sees; any
    other as it is.
    """
    path = posixpath.normpath(path)
    return (
        posixpath.relpath(path, compiler.ROOT)
        if f"{path}/".startswith(f"{compiler.ABOVE}/")
        else path
    )


def _started(main: str) -> "subprocess.Popen[bytes]":
    """The process, without this one's environment."""
    # Not imported: commands choose how it draws before
    package = importlib.util.find_spec("mujoco")
    assert package is not None
    assert package.origin is not None
    folder = str(Path(package.origin).parent)
    return subprocess.Popen(
        [sys.executable, "-I", "-S", compiler.__file__, folder, str(SECONDS), str(MEMORY), main],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={name: os.environ[name] for name in ("LD_LIBRARY_PATH",) if name in os.environ},
    )


def _ended(status: int) -> str:
    """Why the process ended without an answer."""
    if status == -signal.SIGALRM:
        return f"it takes more than {SECONDS} s to compile"
    how = f"signal {-status}" if status < 0 else f"status {status}"
    return _with_limit(
        f"the process that compiles it ended ({how}), perhaps as it could not allocate memory"
    )


def _with_limit(error: str) -> str:
    """An error with the limit that it is about, if it is about memory."""
    return f"{error}; a model may take {MEMORY >> 30} GiB" if "allocate" in error else error
