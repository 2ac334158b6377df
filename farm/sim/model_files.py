"""The files that a MuJoCo model is made of: reading those that an MJCF names, and compiling it where only they are.

MuJoCo itself opens any path that a model names. Here a model reads only what lies in its own folder, and on another
machine only what was sent: names are compared with the files that are there before MuJoCo sees them.
"""

import hashlib
import posixpath
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from farm.errors import ConfigError, brief

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

_Get: TypeAlias = Callable[[str, bool], Content | None]  # by path, and whether as a text

_DIRS: Final = {
    **dict.fromkeys(("mesh", "skin", "flexcomp", "hfield"), ("meshdir", "assetdir")),
    "texture": ("texturedir", "assetdir"),
}
"""Attributes of `compiler` that say where such an element's file lies; all of them for other elements."""


def read(model: str | Path, folder: Path | None) -> dict[str, Content]:
    """Everything that a model reads, by path; the model comes first, as a text.

    Args:
      model: an MJCF text, or a file: in this folder, or anywhere by its absolute path.
      folder: where a text's files and a relative path are; None if there is no such folder. The files of an absolute
        path are in its own.

    Raises:
      ConfigError: a file is missing, too large, or outside the folder; names it, and the file that asks for it.
    """
    if isinstance(model, str):
        if "file" not in model:
            return {TEXT: model}
        name, texts = TEXT, {TEXT: model}
    elif model.is_absolute():
        name, folder, texts = model.name, model.parent, {}
    else:
        name, texts = posixpath.normpath(model.as_posix()), {}
    if folder is None:
        raise ConfigError("the model reads files, but its class is in no file: give xml an absolute path")
    source = _Folder(folder, texts)
    _inside([name], "xml")
    if source.get(name, True) is None:
        raise ConfigError(f"xml: there is no file {folder / name}")
    return _named(name, source.get)


def compiled(mjcf: str, name: str, files: Files | None = None, main: str = TEXT) -> "mujoco.MjModel":
    """Compile an MJCF text.

    Args:
      mjcf: the text.
      name: of the model in messages.
      files: the only files that it may read, by path.
      main: the text's own path among them.

    Raises:
      ConfigError: MuJoCo refuses it, or it reads another file.
    """
    import mujoco  # here, because commands choose how it draws before it is imported

    try:
        model = mujoco.MjModel.from_xml_string(mjcf) if "file" not in mjcf else _from_files(mjcf, files or {}, main)
    except (ValueError, mujoco.FatalError) as error:
        raise ConfigError(f"{name}: MuJoCo refuses the model: {brief(str(error))}") from None
    # An unstable state is not reset, so that its rollout is reported as failed.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return model


def needed(mjcf: str, files: Files, main: str) -> dict[str, Content]:
    """What an MJCF text reads of these files, by path, itself first; a ConfigError if it reads others."""
    if "file" not in mjcf:
        return {main: mjcf}
    contents = {**files, main: mjcf}
    return _named(main, lambda path, _: contents.get(path))


def _from_files(mjcf: str, files: Files, main: str) -> "mujoco.MjModel":
    """Compile it in a folder that has these files only."""
    import mujoco

    contents = needed(mjcf, files, main)
    if len(contents) == 1:
        return mujoco.MjModel.from_xml_string(mjcf)
    with tempfile.TemporaryDirectory(prefix="rolloutfarm-model-") as folder:
        write(Path(folder), contents)
        try:
            return mujoco.MjModel.from_xml_path(str(Path(folder) / main))
        except ValueError as error:
            raise ValueError(str(error).replace(f"{folder}/", "")) from None


def write(folder: Path, files: Files) -> None:
    """Write files whose paths lead nowhere else into a folder."""
    for path, content in files.items():
        _inside([path], "a file's name")
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content.encode() if isinstance(content, str) else content)


def split(files: Files) -> tuple[dict[str, str], dict[str, str]]:
    """Texts, which travel and are kept as they are, and the SHA-256 of the other files, which travel once."""
    texts = {name: content for name, content in files.items() if isinstance(content, str)}
    return texts, {name: digest(content) for name, content in files.items() if isinstance(content, bytes)}


def joined(texts: Mapping[str, str], assets: Mapping[str, str], contents: Mapping[str, bytes]) -> dict[str, Content]:
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

    def __init__(self, folder: Path, contents: Mapping[str, Content]) -> None:
        self._folder, self._read = folder.resolve(), dict(contents)

    def get(self, name: str, text: bool) -> Content | None:
        """A file's content, read once; None if there is no such file."""
        if name not in self._read:
            path = self._folder / name
            if not path.is_file():
                return None
            if not path.resolve().is_relative_to(self._folder):
                raise ConfigError(f"{name} is a link that leads out of {self._folder}: copy the file there")
            if (size := path.stat().st_size) > FILE_LIMIT:
                raise ConfigError(f"{name} has {size >> 20} MiB; a model's file has at most {FILE_LIMIT >> 20} MiB")
            self._read[name] = path.read_bytes()
            if sum(map(len, self._read.values())) > LIMIT:
                raise ConfigError(f"with {name} the model's files have more than {LIMIT >> 20} MiB together")
        content = self._read[name]
        if text and isinstance(content, bytes):
            try:
                content = self._read[name] = content.decode()
            except UnicodeDecodeError:
                raise ConfigError(f"{name} is not a text in UTF-8, but the model reads it as MJCF") from None
        return content


def _named(main: str, get: _Get) -> dict[str, Content]:
    """Everything that a model reads by path, itself first.

    MuJoCo looks for a file in the folders of the model and of the file that names it, and in those of `compiler`.
    Whatever is in one of these places counts.

    Raises:
      ConfigError: a file is in none of them, or one of them is outside.
    """
    contents: dict[str, Content] = {}
    models = [main]
    for model in models:  # grows by the models that are attached
        texts: dict[str, ET.Element] = {}
        waiting = [model]
        while waiting:
            name = waiting.pop(0)
            if name in texts:
                continue
            contents[name] = get(name, True) or ""
            texts[name] = _parsed(name, contents[name])
            for file in (each.get("file", "") for each in texts[name].iter("include")):
                waiting += _places(name, "include", file, _bases(model, name), get, text=True)
        for name, element, file in _references(texts):
            bases, text = _bases(model, name), element.tag == "model"
            if not text:
                bases = [f"{base}/{way}" for base in bases for way in _ways(texts.values(), element.tag)]
                if any(each.get("strippath") == "true" for root in texts.values() for each in root.iter("compiler")):
                    file = posixpath.basename(file)
            places = _places(name, element.tag, file, bases, get, text=text)
            contents |= {place: content for place in places if (content := get(place, text)) is not None}
            models += [place for place in places if text and place not in models]
    return contents


def _references(texts: Mapping[str, ET.Element]) -> Iterator[tuple[str, ET.Element, str]]:
    """Every file that texts name in an element, but for those that are included: text, element, path."""
    for name, root in texts.items():
        for element in root.iter():
            for attribute, file in element.attrib.items():
                if attribute.startswith("file") and file and element.tag != "include":  # also fileright and the like
                    yield name, element, file


def _places(asking: str, tag: str, file: str, bases: Iterable[str], get: _Get, *, text: bool) -> list[str]:
    """Where a file is: those of these folders' that have it."""
    what = f"{asking}: {tag} {file!r}"
    if ":" in file or "\\" in file:
        raise ConfigError(f"{what}: expected a path in the task's folder, with /")
    paths = list(dict.fromkeys(posixpath.normpath(posixpath.join(base, file)) for base in bases))
    _inside(paths, what)
    places = [path for path in paths if get(path, text) is not None]
    if not places:
        raise ConfigError(f"{what}: there is no file {' or '.join(paths)}")
    return places


def _inside(paths: Iterable[str], what: str) -> None:
    for path in paths:
        if path.startswith(("/", "../")) or path == "..":
            raise ConfigError(f"{what} leads out of the task's folder: put the file there, and name it from there")


def _bases(model: str, name: str) -> list[str]:
    """Folders in which a file's names begin."""
    return [posixpath.dirname(model) or ".", posixpath.dirname(name) or "."]


def _ways(roots: Iterable[ET.Element], tag: str) -> list[str]:
    """Folders that `compiler` gives for an element's files."""
    attributes = _DIRS.get(tag, ("meshdir", "texturedir", "assetdir"))
    compilers = [each for root in roots for each in root.iter("compiler")]
    folders = [value for each in compilers for name in attributes if (value := each.get(name))]
    if any(value.startswith("/") or "\\" in value for value in folders):
        raise ConfigError(f"compiler: {folders[0]!r} leads out of the task's folder: give a path inside it, with /")
    return folders or ["."]


def _parsed(name: str, content: Content) -> ET.Element:
    if not isinstance(content, str):
        raise ConfigError(f"{name} is not a text, but the model reads it as MJCF")
    if "<!DOCTYPE" in content or "<!ENTITY" in content:  # MuJoCo and Python read them differently
        raise ConfigError(f"{name} has a document type, which MJCF does not use: remove it")
    try:
        return ET.fromstring(content)
    except ET.ParseError as error:
        raise ConfigError(f"{name} is not well-formed XML: {error}") from None
