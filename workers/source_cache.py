"""Source files received from learners, each in a folder named after its digest; deleted when the worker ends."""

import hashlib
import re
import tempfile
from pathlib import Path
from typing import Final

from farm.errors import UnservedError
from farm.plugins import SOURCE_LIMIT

_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_NAME: Final = re.compile(r"\w[\w. -]{0,100}\.py")  # cannot lead out of its folder


class SourceCache:
    """Files by digest, in a temporary folder that only this user can read."""

    def __init__(self) -> None:
        """Start without a folder: most workers need none."""
        self._root: tempfile.TemporaryDirectory[str] | None = None

    @property
    def _folder(self) -> Path:
        if self._root is None:
            self._root = tempfile.TemporaryDirectory(prefix="rolloutfarm-code-")  # mode 0700
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
        if not _NAME.fullmatch(name) or not _DIGEST.fullmatch(digest):
            raise UnservedError(f"{name[:100]!r} is not a valid name for a file; expected letters, digits and .py")
        return self._folder / digest / name

    def keep(self, name: str, digest: str, source: bytes) -> Path:
        """Store a received source; returns its path.

        Raises:
          UnservedError: it is too large, or does not match its digest.
        """
        path = self.place(name, digest)
        if len(source) > SOURCE_LIMIT:
            raise UnservedError(f"the received source of {name} has more than {SOURCE_LIMIT} bytes")
        if hashlib.sha256(source).hexdigest() != digest:
            raise UnservedError(f"the received source of {name} does not match its digest")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(source)
        return path

    def close(self) -> None:
        """Delete all files."""
        if self._root is not None:
            self._root.cleanup()
            self._root = None
