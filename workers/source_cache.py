"""Sources that learners sent, each in a folder of its digest's name, as long as the worker lives."""

import hashlib
import re
import tempfile
from pathlib import Path
from typing import Final

from farm.errors import UnservedError
from farm.plugins import SOURCE_LIMIT

_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_NAME: Final = re.compile(r"\w[\w. -]{0,100}\.py")  # nothing of it leads out of a folder


class SourceCache:
    """Files by digest, in a temporary folder that nobody else can look into."""

    def __init__(self) -> None:
        """Begin without a folder: most workers need none."""
        self._root: tempfile.TemporaryDirectory[str] | None = None

    @property
    def _folder(self) -> Path:
        if self._root is None:
            self._root = tempfile.TemporaryDirectory(prefix="rolloutfarm-code-")  # mode 0700
        return Path(self._root.name)

    @property
    def empty(self) -> Path:
        """A folder to run what is kept here in."""
        folder = self._folder / "run"
        folder.mkdir(exist_ok=True)
        return folder

    def place(self, name: str, digest: str) -> Path:
        """Where a file is kept, or will be.

        Raises:
          UnservedError: the name or the digest is none.
        """
        if not _NAME.fullmatch(name) or not _DIGEST.fullmatch(digest):
            raise UnservedError(f"{name[:100]!r} is no name of a file that travels; expected letters, digits and .py")
        return self._folder / digest / name

    def keep(self, name: str, digest: str, source: bytes) -> Path:
        """Write down a source that came; its path.

        Raises:
          UnservedError: it is too large, or not what the digest says.
        """
        path = self.place(name, digest)
        if len(source) > SOURCE_LIMIT:
            raise UnservedError(f"the source of {name} that came has more than {SOURCE_LIMIT} bytes")
        if hashlib.sha256(source).hexdigest() != digest:
            raise UnservedError(f"the source of {name} that came does not fit its digest")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(source)
        return path

    def close(self) -> None:
        """Delete all of it."""
        if self._root is not None:
            self._root.cleanup()
            self._root = None
