"""The files that a MuJoCo model is made of: MuJoCo itself says which they are, and compiles it from
nothing else.
"""

import hashlib
import posixpath
import re
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from farm.errors import ConfigError, brief
from farm.sim.compiling import Compiled, RefusedError, compile_model

if TYPE_CHECKING:
    import mujoco

FILE_LIMIT: Final = 32 << 20
"""Largest size of one file [bytes]; it travels as one message."""

LIMIT: Final = 128 << 20
"""Largest size of all files of a model [bytes]."""

TEXT: Final = "model.xml"
"""Name of a model that is given as a text."""

Content: TypeAlias = str | bytes
Files: TypeAlias = Mapping[str, Content]
"""Texts and other files by their paths in a folder, with /."""

SUFFIXES: Final = (".xml", ".mjcf", ".urdf")
"""Suffixes of texts that are models, or parts of them; other files are taken as they are."""

_OPENING: Final = re.compile(r"[Oo]pening file '(.*?)'")
_KEPT: Final = 4  # compiled models
_KEPT_SIZE: Final = 64 << 20  # [bytes] of one
_SMALL: Final = 4 << 20  # [bytes]; it compiles in much less than a second


def read(model: str | Path, folder: Path | None) -> dict[str, Content]:
    """Everything that a model reads, by path; the model comes first, as a text.

    MuJoCo compiles the model, and what it opens is read.

    Args:
      model: a text of MJCF or URDF, or a file: in this folder, or by its absolute path, given as
          Path or text.
      folder: where all its files are; None: in the folder of the file that an absolute path names.

    Raises:
      ConfigError: MuJoCo refuses the model, or a file is missing, too large, or outside the folder.
    """
    if not isinstance(model, str | Path):
        raise ConfigError(f"xml is a {type(model).__name__}; expected a text or a path of a model")
    if isinstance(model, str) and "<" in model:
        if "file" not in model:
            return {TEXT: model}
        name, texts = TEXT, {TEXT: model}
    else:
        path = Path(model)
        name = posixpath.normpath(path.as_posix())
        texts = {}
        if path.is_absolute():
            folder = folder if folder is not None and path.is_relative_to(folder) else path.parent
            name = path.relative_to(folder).as_posix()
        if path.suffix.lower() not in SUFFIXES:
            raise ConfigError(
                f"xml: {name}: expected a model, with a name that ends in {', '.join(SUFFIXES)}"
            )
    if folder is None:
        raise ConfigError(
            "the model reads files, but its class is in no file: give xml an absolute path"
        )
    source = _Folder(folder, name, texts)
    if source.get(name) is None:
        if source.outside:
            raise ConfigError(f"xml: {source.lies_outside(name)}")
        raise ConfigError(f"xml: there is no file {folder / name}")
    try:
        result = compile_model(name, source.get)
    except RefusedError as error:
        raise ConfigError(f"{name}: {source.explained(error)}") from None
    contents = {path: source.contents[path] for path in result.paths}
    _keep(_key(contents, name), result)
    return contents


def compiled(
    mjcf: str, name: str, files: Files | None = None, main: str = TEXT
) -> "mujoco.MjModel":
    """Compile a text of MJCF or URDF.

    Args:
      mjcf: the text.
      name: of the model in messages.
      files: the only files that it may read, by path.
      main: the text's own path among them.

    Raises:
      ConfigError: MuJoCo refuses it, it reads another file, or it takes too much time or memory.
    """
    import mujoco  # here, because commands choose how it draws before it is imported

    try:
        binary = _compiled({**(files or {}), main: mjcf}, main).binary
        model = mujoco.MjModel.from_binary_path("model.mjb", assets={"model.mjb": binary})
    except (RefusedError, ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"{name}: MuJoCo refuses the model: {brief(str(error))}") from None
    # An unstable state is not reset, so that its rollout is reported as failed.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def needed(mjcf: str, files: Files, main: str) -> dict[str, Content]:
    """Files that a text reads, by path, itself first; a ConfigError if MuJoCo refuses
    it.
    """
    contents = {**files, main: mjcf}
    return {path: contents[path] for path in _compiled(contents, main).paths}


def _compiled(contents: Files, main: str) -> Compiled:
    """The compiled model of texts and other files; some of them are kept, since a process needs
    one several times.
    """
    key = _key(contents, main)
    if key in _kept:
        return _kept[key]

    def get(path: str) -> bytes | None:
        content = contents.get(path)
        return content.encode() if isinstance(content, str) else content

    model = compile_model(main, get)
    _keep(key, model)
    return model


def split(files: Files) -> tuple[dict[str, str], dict[str, str]]:
    """Texts, which travel and are kept as they are, and the SHA-256 of the other files, which
    travel once.
    """
    texts = {name: content for name, content in files.items() if isinstance(content, str)}
    return texts, {
        name: digest(content) for name, content in files.items() if isinstance(content, bytes)
    }


def joined(
    texts: Mapping[str, str], assets: Mapping[str, str], contents: Mapping[str, bytes]
) -> dict[str, Content]:
    """The files again, from their contents by SHA-256."""
    return {**texts, **{name: contents[digest] for name, digest in assets.items()}}


def by_digest(files: Files) -> dict[str, bytes]:
    """The contents of the files that are no texts, by SHA-256."""
    return {digest(content): content for content in files.values() if isinstance(content, bytes)}


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


class _Folder:
    """A folder from which a model reads, within its limits."""

    def __init__(self, folder: Path, main: str, texts: Mapping[str, str]) -> None:
        self._folder = folder.resolve()
        self._named = folder
        self._main = main
        self.contents: dict[str, Content] = {
            path: self._relative(text) for path, text in texts.items()
        }
        """What was read, by path."""
        self.outside = ""
        """The first path that leads out of the folder."""

    def get(self, path: str) -> bytes | None:
        """A file's content, read once; None if there is no such file."""
        if path.startswith(("/", "../")) or path == "..":
            self.outside = self.outside or path
            return None
        if path not in self.contents:
            file = self._folder / path
            if not file.is_file():
                return None
            self.contents[path] = self._content(path, file)
            if sum(map(len, self.contents.values())) > LIMIT:
                raise ConfigError(
                    f"with {path} the model's files have more than {LIMIT >> 20} MiB together"
                )
        content = self.contents[path]
        return content.encode() if isinstance(content, str) else content

    def _content(self, path: str, file: Path) -> Content:
        if not file.resolve().is_relative_to(self._folder):
            raise ConfigError(
                f"{path} is a link that leads out of {self._folder}: copy the file there"
            )
        if (size := file.stat().st_size) > FILE_LIMIT:
            raise ConfigError(
                f"{path} has {size >> 20} MiB; a model's file has at most {FILE_LIMIT >> 20} MiB"
            )
        content = file.read_bytes()
        if file.suffix.lower() not in SUFFIXES:
            return content
        return self._relative(decoded(content))

    def _relative(self, text: str) -> str:
        """A text whose absolute paths in the folder are relative to the model's: it is compiled
        elsewhere, too.
        """
        way = posixpath.relpath(".", posixpath.dirname(self._main) or ".")
        for folder in {str(self._folder), str(self._named)} - {"/"}:
            for quote in "\"'":
                text = text.replace(f"{quote}{folder}/", f"{quote}{way}/")
                text = text.replace(f"{quote}{folder}{quote}", f"{quote}{way}{quote}")
        return text

    def explained(self, error: RefusedError) -> str:
        """MuJoCo's refusal, with what to do if it is about a file."""
        file = _OPENING.search(str(error))
        if file is None:
            return f"MuJoCo refuses the model: {error}"
        name = posixpath.basename(file[1])
        missing = [
            path for path in dict.fromkeys(error.missing) if posixpath.basename(path) == name
        ] or [file[1]]
        outside = next((path for path in missing if path.startswith(("/", "../"))), "")
        return self.lies_outside(outside) if outside else f"there is no file {' or '.join(missing)}"

    def lies_outside(self, path: str) -> str:
        """Text of an error: a path leads out of the folder, and what to do."""
        if path.startswith("/"):
            return (
                f"{path} lies outside of {self._folder}: put the file there, and name it from there"
            )
        above = path.split("/").count("..")
        folder = self._folder.parents[min(above, len(self._folder.parents)) - 1]
        return (
            f"{path} lies outside of the task's folder {self._folder}: put the task's file into"
            f" {folder} and name the model from there, or give the class that folder: root ="
            " Path(...)"
        )


def decoded(content: bytes) -> str:
    """A model's text in UTF-8, or in Latin-1 if it is not."""
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _key(contents: Files, main: str) -> str:
    """Digest of all that a compiled model depends on."""
    digests = [
        (path, digest(each.encode() if isinstance(each, str) else each))
        for path, each in contents.items()
    ]
    return digest(repr((main, sorted(digests))).encode())


_kept: OrderedDict[str, Compiled] = OrderedDict()


def _keep(key: str, model: Compiled) -> None:
    """Keep a compiled model in place of the oldest, unless it is large."""
    if len(model.binary) <= _KEPT_SIZE:
        _kept[key] = model
    while len(_kept) > _KEPT:
        _kept.popitem(last=False)


def keep_small() -> None:
    """Forget compiled models that take much memory: for processes that have built what they
    simulate.
    """
    for key in [key for key, model in _kept.items() if len(model.binary) > _SMALL]:
        del _kept[key]
