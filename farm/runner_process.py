"""A process that runs one run's jobs for another one: `python -m farm.runner_process SOCKET`, or
`-` for its standard streams.

It has no session and no certificate; its owner (`farm.subprocess_runner`) sends it jobs and reads
the results. A worker starts one for code that was received over the network (docs/protocol.md,
"Code that travels", says what it can still access), a learner one that repeats jobs as a check.
"""

import ctypes
import os
import signal
import socket
import struct
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

from farm import fingerprint, plugins
from farm.arrays import FloatArray, array
from farm.building import built
from farm.errors import FarmError, MessageError, UnservedError, brief, described
from farm.net import codec
from farm.net.codec import M
from farm.net.messages import Spec
from farm.net.work import Jobs, Simulated
from farm.runner import make_backend

_MOST: Final = 4 * codec.MAX_BYTES  # [bytes] of a mean, a chunk, a normaliser and their headers
_LENGTH: Final = struct.Struct("<Q")
_PARENT_DIED: Final = 1  # prctl's PR_SET_PDEATHSIG (linux/prctl.h)
_FILES: Final = 1024  # descriptors that a process may have inherited
_NO_NEW_PRIVILEGES: Final = 38  # and its PR_SET_NO_NEW_PRIVS


@dataclass(frozen=True, kw_only=True)
class Begin:
    """The run that the process executes; its first message."""

    spec: Spec
    files: tuple[str, ...]
    """Paths of the files whose classes it may load."""
    backend: str
    assets: str = ""
    """Folder of the files that its model reads, by digest."""
    fingerprint: bool = False
    """Whether the reply has the machine's fingerprint."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """Jobs, as `Runner.run` takes them."""

    jobs: Jobs
    traces: str
    mu: FloatArray = array("<f8", 1)
    normaliser: FloatArray = array("<f8", 3)
    terms: bool = False


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The reply to the last message."""

    size: int = 0
    """Number of policy parameters; in the reply to Begin."""
    fingerprint: str = ""
    """How the process's machine rounds; in the reply to a Begin that asks for it."""
    results: Simulated | None = None
    """Results of the jobs; in the reply to an Order."""
    error: str = ""
    served: bool = True
    """False: this process can run no job of this run."""
    traceback: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the traceback can be displayed by the learner: the process is not trusted."""
        if len(self.traceback) > 40 or not all(
            len(line) <= 1000 and line.isprintable() for line in self.traceback
        ):
            raise ValueError("a traceback of more than 40 lines, long lines, or unprintable ones")


class Link(Protocol):
    """What a message is sent over; a socket is one."""

    def settimeout(self, value: float | None, /) -> None:
        """Limit the time of each of the following calls [s]."""
        ...

    def sendall(self, data: bytes, /) -> None:
        """Send all bytes."""
        ...

    def recv(self, bufsize: int, /) -> bytes:
        """Receive at most so many bytes; none if the other side is gone."""
        ...


class StandardStreams:
    """The streams that this process was started with; what it prints goes to standard error."""

    def __init__(self) -> None:
        """Take them."""
        self._source = os.dup(0)
        self._sink = os.dup(1)
        os.dup2(2, 1)
        empty = os.open(os.devnull, os.O_RDONLY)
        os.dup2(empty, 0)
        os.close(empty)

    def settimeout(self, value: float | None, /) -> None:
        """Do nothing: this side waits as long as it takes."""

    def sendall(self, data: bytes, /) -> None:
        """Send all bytes."""
        view = memoryview(data)
        while view:
            view = view[os.write(self._sink, view) :]

    def recv(self, bufsize: int, /) -> bytes:
        """Receive at most so many bytes; none if the other side is gone."""
        return os.read(self._source, bufsize)


def send(link: Link, message: object, seconds: float | None = None) -> None:
    """Send a message within the time; raises TimeoutError or another OSError if that fails."""
    payload = codec.encode(message)
    link.settimeout(seconds)
    link.sendall(_LENGTH.pack(len(payload)) + payload)


def receive(link: Link, kind: type[M], seconds: float | None = None) -> M:
    """Receive the next message.

    Raises:
      OSError: none arrived in time (TimeoutError), or the connection is closed.
      MessageError: it is of another kind.
    """
    until = None if seconds is None else time.monotonic() + seconds
    (length,) = _LENGTH.unpack(_exactly(link, _LENGTH.size, until))
    if length > _MOST:
        raise MessageError(f"a message of {length} bytes; at most {_MOST} are taken", "large")
    return codec.decode(bytes(_exactly(link, length, until)), kind, most=_MOST)


def _exactly(link: Link, count: int, until: float | None) -> bytearray:
    content = bytearray()
    while len(content) < count:
        link.settimeout(None if until is None else max(1e-3, until - time.monotonic()))
        part = link.recv(min(count - len(content), 1 << 20))
        if not part:
            raise ConnectionResetError("the other side is gone")
        content += part
    return content


def serve(link: Link) -> None:
    """Build the task and run jobs until the owner closes the connection."""
    begin = receive(link, Begin)
    try:
        files = tuple(Path(path) for path in begin.files)
        contents = {
            name: (Path(begin.assets) / name).read_bytes() for name in begin.spec.assets.values()
        }
        backend = make_backend(begin.backend)
        runner = built(begin.spec, files, contents, backend)
    except Exception as error:  # the code may raise anything
        send(link, _failed(error, begin.files, built=False))
        return
    digest = fingerprint.digest() if begin.fingerprint else ""
    send(link, Answer(size=runner.size, fingerprint=digest))
    while True:
        order = receive(link, Order)
        try:
            results = runner.run(
                order.mu, order.jobs, order.traces, order.normaliser, terms=order.terms
            )
            text, lines = _named((results.error, results.traceback), begin.files)
            answer = Answer(results=replace(results, error=text, traceback=lines))
        except Exception as error:
            answer = _failed(error, begin.files)
        send(link, answer)


def _failed(error: Exception, files: tuple[str, ...], *, built: bool = True) -> Answer:
    text = str(error) if isinstance(error, FarmError) else described(error)
    if isinstance(plugins.root(error), FileNotFoundError):
        text += (
            "; files beside a class do not travel, but those that its xml names do, and neighbours"
        )
    text, lines = _named((text, plugins.author_traceback(error)), files)
    return Answer(
        error=brief(text), served=built and not isinstance(error, UnservedError), traceback=lines
    )


def _named(
    error: tuple[str, tuple[str, ...]], files: tuple[str, ...]
) -> tuple[str, tuple[str, ...]]:
    """An error and its traceback, with names in place of paths: the author knows no path of this
    machine.
    """
    text, lines = error
    for path in files:
        folder = f"{Path(path).parent}/" if Path(path).is_absolute() else ""
        for long, short in ((path, Path(path).name), *([(folder, "")] if folder else [])):
            text = text.replace(long, short)
            lines = tuple(line.replace(long, short) for line in lines)
    return text, lines


def bound() -> None:
    """End with the owner, gain no privileges (both on Linux only), and dump no core."""
    if sys.platform == "linux":
        kernel = ctypes.CDLL(None)
        kernel.prctl(_PARENT_DIED, signal.SIGKILL, 0, 0, 0)
        kernel.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    with suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def guard() -> None:
    """Fork a process that ends all of this process's group when this process ends, however it does
    (on Linux only).

    The group has what the code forks. A worker that is killed cannot end it, but this process ends
    with its worker.
    """
    guarded = os.getpid()
    if sys.platform != "linux" or os.getpgrp() != guarded or os.fork():
        return
    os.closerange(3, _FILES)  # the socket is not the guard's
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    ctypes.CDLL(None).prctl(_PARENT_DIED, signal.SIGTERM, 0, 0, 0)
    if os.getppid() == guarded:  # else it has ended already
        signal.sigwait({signal.SIGTERM})
    os.killpg(0, signal.SIGKILL)


def main() -> None:
    """Drop privileges, then serve on the inherited socket, or on the standard streams."""
    bound()
    guard()
    with suppress(OSError):  # the owner is gone
        if sys.argv[1] == "-":
            serve(StandardStreams())
            return
        with socket.socket(fileno=int(sys.argv[1])) as link:
            link.set_inheritable(False)
            serve(link)


if __name__ == "__main__":
    main()
