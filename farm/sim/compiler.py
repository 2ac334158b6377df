"""The process that compiles a model: `python -I -S compiler.py FOLDER SECONDS BYTES MAIN`, of
`farm.sim.compiling`.

It uses MuJoCo's library without the packages around it. Every file that MuJoCo opens is asked of
the process that started it: MuJoCo sees a folder that exists nowhere, and the system opens no other
file for this process. It is run as a script, so that it starts within some milliseconds, and
imports nothing of the farm.
"""

import ctypes
import os
import signal
import struct
import sys
import threading
from pathlib import Path
from typing import IO, Any, Final

ABOVE: Final = "/up"
"""The folder that MuJoCo sees; nothing of this name need exist."""
ROOT: Final = f"{ABOVE}/up/up/up/up/up/up/up/task"
"""The model's folder in it: so deep that a path with .. can be told from others, and is asked for.
"""

HEADER: Final = struct.Struct("<cQ")
"""Kind and length of a message."""

ASKED: Final = b"?"
"""What MuJoCo opens, by its path."""
FOUND: Final = b"+"
"""The answer: the file's content."""
MISSING: Final = b"-"
"""The other answer: there is no such file."""
COMPILED: Final = b"="
"""The compiled model, as MuJoCo's binary file."""
REFUSED: Final = b"!"
"""MuJoCo's reason not to compile it."""

_ERROR: Final = 1000  # [bytes], as MuJoCo's own programs have


def send(stream: IO[bytes], kind: bytes, content: Any = b"") -> None:  # noqa: ANN401  bytes, or ctypes' buffer
    """Send a message."""
    stream.write(HEADER.pack(kind, len(content)))
    stream.write(content)
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[bytes, bytes]:
    """Receive a message: its kind and content; EOFError if the other side is gone."""
    header = stream.read(HEADER.size)
    if len(header) < HEADER.size:
        raise EOFError
    kind, length = HEADER.unpack(header)
    content = stream.read(length)
    if len(content) < length:
        raise EOFError
    return kind, content


class _Resource(ctypes.Structure):
    """mjResource of mujoco/mjplugin.h: an open file."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("vfs", ctypes.c_void_p),
        ("timestamp", ctypes.c_char * 512),
        ("provider", ctypes.c_void_p),
        ("args", ctypes.c_char_p),
    )


_OnResource: Final = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(_Resource))
_OnRead: Final = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.POINTER(_Resource), ctypes.POINTER(ctypes.c_void_p)
)
_OnClose: Final = ctypes.CFUNCTYPE(None, ctypes.POINTER(_Resource))


class _Provider(ctypes.Structure):
    """mjpResourceProvider of mujoco/mjplugin.h: what opens and reads files."""

    _fields_ = (
        ("prefix", ctypes.c_char_p),
        ("open", _OnResource),
        ("read", _OnRead),
        ("close", _OnClose),
        ("mount", _OnResource),
        ("unmount", _OnResource),
        ("modified", ctypes.c_void_p),
        ("write", ctypes.c_void_p),
        ("data", ctypes.c_void_p),
    )


class _Folder:
    """The folder that MuJoCo sees."""

    def __init__(self, questions: IO[bytes], answers: IO[bytes]) -> None:
        self._questions = questions
        self._answers = answers
        self._lock = threading.Lock()  # MuJoCo reads meshes in threads
        self._contents: dict[bytes, bytes] = {}
        self.provider = _Provider(
            open=_OnResource(self._open),
            read=_OnRead(self._read),
            close=_OnClose(lambda _: None),
            mount=_OnResource(lambda _: 1),
            unmount=_OnResource(lambda _: 1),
        )

    def _open(self, opened: Any) -> int:  # noqa: ANN401  ctypes' pointer
        name = opened.contents.name
        with self._lock:
            if name not in self._contents:
                send(self._questions, ASKED, name)
                kind, content = receive(self._answers)
                if kind != FOUND:
                    return 0
                self._contents[name] = content
        return 1

    def _read(self, opened: Any, buffer: Any) -> int:  # noqa: ANN401
        content = self._contents[opened.contents.name]
        buffer[0] = ctypes.cast(ctypes.c_char_p(content), ctypes.c_void_p).value
        return len(content)


def _library(folder: Path) -> Any:  # noqa: ANN401  functions by name
    """MuJoCo, with the plug-ins that it comes with."""
    beside = [str(path) for path in folder.glob("libmujoco.*")]
    library = ctypes.CDLL(beside[0] if beside else "libmujoco.so")  # conda has it elsewhere
    library.mj_loadPluginLibrary.argtypes = [ctypes.c_char_p]
    library.mj_mountVFS.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    library.mj_loadXML.argtypes = [ctypes.c_char_p, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int]
    library.mj_loadXML.restype = ctypes.c_void_p
    library.mj_sizeModel.argtypes = [ctypes.c_void_p]
    library.mj_sizeModel.restype = ctypes.c_int64
    library.mj_saveModel.argtypes = [
        ctypes.c_void_p,
        ctypes.c_char_p,
        ctypes.c_void_p,
        ctypes.c_int64,
    ]
    # In the order in which mujoco's package loads them: a compiled model has their numbers.
    for directory, _, names in os.walk(folder / "plugin"):
        for name in names:
            if name.endswith((".so", ".dylib")):
                library.mj_loadPluginLibrary(bytes(Path(directory, name)))
    return library


def _limit(seconds: int, size: int) -> None:
    """Let the system end this process after some time, give it no more memory, and open no file for
    it.

    Without these limits, as on Windows, nothing is compiled.
    """
    import resource

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its starter decides
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(seconds)
    # On Linux what is used counts, not what threads reserve.
    memory = resource.RLIMIT_DATA if sys.platform == "linux" else resource.RLIMIT_AS
    _, most = resource.getrlimit(memory)
    size = size if most == resource.RLIM_INFINITY else min(size, most)
    resource.setrlimit(memory, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))


def main() -> None:
    """Compile the model, and send it or the reason why not."""
    mujoco, seconds, size, name = sys.argv[1:]
    answers = sys.stdin.buffer
    questions = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # MuJoCo prints
    library = _library(Path(mujoco))
    system = [bytes(path) for path in Path("/").iterdir()]
    folder, files = _Folder(questions, answers), ctypes.c_void_p()
    _limit(int(seconds), int(size))
    library.mj_defaultVFS(ctypes.byref(files))
    # The system's folders are mounted, so that MuJoCo cannot find out which files this machine has.
    for mounted in {ABOVE.encode(), b"/..", *system}:
        library.mj_mountVFS(ctypes.byref(files), mounted, ctypes.byref(folder.provider))
    error = ctypes.create_string_buffer(_ERROR)
    model = library.mj_loadXML(os.fsencode(f"{ROOT}/{name}"), ctypes.byref(files), error, _ERROR)
    if not model:
        send(questions, REFUSED, error.value)
        return
    content = ctypes.create_string_buffer(library.mj_sizeModel(model))
    library.mj_saveModel(model, None, content, len(content))
    send(questions, COMPILED, content)


if __name__ == "__main__":
    main()
