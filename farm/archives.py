"""Reads .npz files that other people made: headers first, so that a small file cannot fill the
memory.
"""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib import format as npy

from farm.arrays import AnyArray
from farm.errors import ConfigError, brief

_ENTRIES: Final = 10_000  # of one file
_SCALAR: Final = 4 << 20  # [bytes] of a number or text
MOST: Final = 1 << 30
"""Largest size of all arrays of a file that are read [bytes]."""


@dataclass(frozen=True)
class Header:
    """Shape and type of an array in a file, from its header."""

    shape: tuple[int, ...]
    dtype: "np.dtype[Any]"

    @property
    def nbytes(self) -> int:
        """Size of the array [bytes]."""
        return math.prod(self.shape) * self.dtype.itemsize


def headers(path: Path, what: str) -> dict[str, Header]:
    """The arrays of a file by name, of which only the headers are read.

    Args:
      path: the file.
      what: it should be, for errors.

    Raises:
      ConfigError: it is damaged, or something else.
    """
    with _opened(path, what) as file:
        return {name: _header(file, entry) for name, entry in _entries(file).items()}


def scalars(path: Path, what: str) -> dict[str, Any]:
    """The numbers and texts of a file by name, without its arrays; arguments and errors as in
    `headers`.
    """
    with _opened(path, what) as file:
        values = {}
        for name, entry in _entries(file).items():
            header = _header(file, entry)
            if header.shape:
                continue
            if header.nbytes > _SCALAR:
                raise ValueError(
                    f"{name} has {header.nbytes >> 20} MiB, at most {_SCALAR >> 20} are read"
                )
            values[name] = _array(file, entry).item()
        return values


def arrays(path: Path, what: str, most: int = MOST) -> dict[str, AnyArray]:
    """Read all arrays of a file by name, if they have `most` bytes together at most; errors as in
    `headers`.
    """
    with _opened(path, what) as file:
        entries = _entries(file)
        size = sum(_header(file, entry).nbytes for entry in entries.values())
        if size > most:
            raise ValueError(f"its arrays have {size >> 20} MiB, at most {most >> 20} are read")
        return {name: _array(file, entry) for name, entry in entries.items()}


@contextmanager
def _opened(path: Path, what: str) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as file:
            yield file
    except Exception as error:  # zipfile, zlib and numpy raise many kinds for damaged files
        raise ConfigError(
            f"{path} is no {what}, or damaged: {brief(str(error) or type(error).__name__)}"
        ) from None


def _entries(file: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    entries = file.infolist()
    if len(entries) > _ENTRIES:
        raise ValueError(f"{len(entries)} arrays, at most {_ENTRIES} are read")
    return {entry.filename.removesuffix(".npy"): entry for entry in entries}


def _header(file: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Header:
    with file.open(entry) as content:
        version = npy.read_magic(content)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"an array of version {version}")
        parse = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = parse(content)
    if dtype.hasobject or not all(0 <= each <= MOST for each in shape):
        raise ValueError("an array of an unknown kind")
    return Header(shape, dtype)


def _array(file: zipfile.ZipFile, entry: zipfile.ZipInfo) -> AnyArray:
    with file.open(entry) as content:
        values: AnyArray = npy.read_array(content, allow_pickle=False)
        return values
