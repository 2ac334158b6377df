"""Files received from learners, by their digests; deleted when the worker ends: sources, and what
models read.

A worker that is killed leaves its files behind. Each worker locks its folder, and one that starts
deletes those of this user whose lock is free.
"""

import fcntl
import hashlib
import os
import re
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from farm import neighbours
from farm.errors import UnservedError
from farm.plugins import FILE_NAME, SOURCE_LIMIT
from farm.replacing import replacing
from farm.sim.model_files import FILE_LIMIT
from farm.sim.model_files import digest as digest_of

_PREFIX: Final = "rolloutfarm-code-"
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_ASSETS: Final = 1 << 30  # [bytes] of files that models read


class SourceCache:
    """Files by digest, in a temporary folder that only this user can read."""

    def __init__(self) -> None:
        """Start without a folder: most workers need none."""
        self._root: tempfile.TemporaryDirectory[str] | None = None
        self._lock = -1  # descriptor of the locked folder

    @property
    def _folder(self) -> Path:
        if self._root is None:
            _clear()
            self._root, self._lock = _locked()
        return Path(self._root.name)

    @property
    def empty(self) -> Path:
        """The working directory for processes that execute these files."""
        folder = self._folder / "run"
        folder.mkdir(exist_ok=True)
        return folder

    def place(self, name: str, digest: str) -> Path:
        """The path at which a file is kept or will be kept.

        Raises:
          UnservedError: the name or the digest is malformed.
        """
        if not FILE_NAME.fullmatch(name) or not _DIGEST.fullmatch(digest):
            raise UnservedError(
                f"{name[:100]!r} is not a valid name for a file; expected letters, digits and .py"
            )
        return self._folder / digest / name

    def keep(self, name: str, digest: str, source: bytes) -> Path:
        """Store a received source, with its neighbours beside it; returns its path.

        Raises:
          UnservedError: it is too large, does not match its digest, or is no bundle of files.
        """
        path = self.place(name, digest)
        if len(source) > SOURCE_LIMIT:
            raise UnservedError(f"the received source of {name} has more than {SOURCE_LIMIT} bytes")
        if hashlib.sha256(source).hexdigest() != digest:
            raise UnservedError(f"the received source of {name} does not match its digest")
        try:
            module, others = neighbours.unpacked(source)
        except ValueError as error:
            raise UnservedError(f"the received source of {name} is {error}") from None
        if path.stem in others:
            raise UnservedError(f"the received source of {name} has that file twice")
        path.parent.mkdir(exist_ok=True)
        for each, content in others.items():
            _write(path.with_name(f"{each}.py"), content)
        _write(path, module)  # last: with it the source counts as received
        return path

    @property
    def assets(self) -> Path:
        """The folder of files that models read, named by their digests."""
        folder = self._folder / "assets"
        folder.mkdir(exist_ok=True)
        return folder

    def keep_asset(self, digest: str, content: bytes) -> None:
        """Store a received file that a model reads.

        Raises:
          UnservedError: it is too large, does not match its digest, or there is no room for it.
        """
        if len(content) > FILE_LIMIT or digest_of(content) != digest:
            raise UnservedError(
                f"a received file of {len(content)} bytes does not match its digest, or is too"
                " large"
            )
        total = sum(path.stat().st_size for path in self.assets.iterdir())
        if total + len(content) > _ASSETS:
            raise UnservedError(
                f"this worker holds {total >> 20} MiB of models' files and takes no more:"
                " restart it"
            )
        _write(self.assets / digest, content)

    def close(self) -> None:
        """Delete all files."""
        if self._root is not None:
            self._root.cleanup()
            os.close(self._lock)
            self._root = None


def _write(path: Path, content: bytes) -> None:
    """Write a whole file; an UnservedError, and no file, if there is no room for it."""
    try:
        with replacing(path) as aside:
            aside.write_bytes(content)
    except OSError as error:
        raise UnservedError(f"cannot write a received file: {error.strerror}; make room") from None


def _locked() -> tuple["tempfile.TemporaryDirectory[str]", int]:
    """A new folder, and the descriptor that keeps it locked until this process ends, however it
    ends.
    """
    while True:
        root = tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True)  # mode 0700
        with suppress(FileNotFoundError):
            folder = os.open(root.name, os.O_RDONLY)
            fcntl.flock(folder, fcntl.LOCK_EX)
            if Path(root.name).is_dir():
                return root, folder
            os.close(folder)
        # Another worker took it for one that was left, in the moment before it was locked
        root.cleanup()


def _clear() -> None:
    """Delete the folders of this user's workers that were killed: their locks are free."""
    for path in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # it is locked, or another worker is deleting it
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(folder).st_uid == os.getuid():
                    fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path)
            finally:
                os.close(folder)
