"""Where a pool's workers are: processes of this machine, other machines, or a router."""

import shlex
import socket
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from farm.errors import ConfigError
from farm.net.tls import Bundle
from farm.net.zenoh_settings import LISTEN
from farm.targets import typed
from learner.pool.scheduler import SchedulerConfig

MOST_WORKERS: Final = 1024
"""Local worker processes of a pool."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Placement of a pool on the network and on this machine; does not affect its numbers."""

    workers: int = 0
    """Number of local worker processes."""
    backend: str = "cpu"
    """Simulation backend of the local workers."""
    listen: str = LISTEN
    """Where the learner listens for workers."""
    connect: tuple[str, ...] = ()
    """Routers to connect to instead of listening."""
    farm: str = "farm"
    """Name of the farm."""
    tls: Bundle | None = None
    """The learner's certificates."""
    trusted: bool = False
    """Listen to other machines without certificates."""
    fingerprint: str = ""
    """Fingerprint of the machines whose numbers a new run accepts, or how it begins.

    By default this machine's.
    """
    any_rounding: bool = False
    """Admit workers whose machines round differently, and code that has changed since the run
    started.
    """
    checker: str = ""
    """Command of the Python that checks answers of other machines; empty for this one."""
    scheduler: SchedulerConfig = field(default_factory=SchedulerConfig)
    """How jobs are split into chunks, and when they are reissued."""


def check_workers(workers: object) -> None:
    """Check a number of local workers; raises ConfigError if it is invalid."""
    if type(workers) is not int or not 1 <= workers <= MOST_WORKERS:
        raise ConfigError(
            f"workers is {workers!r}; expected 1 to {MOST_WORKERS} processes on this machine"
        )


def local_flags(place: Placement, files: Iterable[object]) -> list[str]:
    """Arguments of the local worker processes, which may serve these files."""
    # The learner reports their state
    quiet = ["--log-level", "WARNING"]
    return [*_address(place), *_allowing(files), "--backend", place.backend, *quiet]


def how_to_join(place: Placement, files: Iterable[Path]) -> str:
    """The command with which workers join; with certificates, that of the first machine that may.

    A class in a file is sent to workers with certificates. Without, a worker on another machine has
    a copy of the file.
    """
    if place.tls:
        code = ["--accept-code"] if tuple(files) else []
    else:
        code = _allowing(path.name if place.trusted else path for path in files)
    # Where the address means all of this machine's, other machines need its name
    host = socket.gethostname()
    if place.tls and place.tls.hosts and host not in place.tls.hosts:
        host = place.tls.hosts[0]  # another would be refused
    tls, note = ([], []) if place.tls is None else _certificate(place.tls)
    words = shlex.join(["farm", "worker", *_address(place), *tls, *code])
    command = " ".join([words, *note])
    return command.replace("/0.0.0.0:", f"/{host}:").replace("/[::]:", f"/{host}:")


def _certificate(bundle: Bundle) -> tuple[list[str], list[str]]:
    """The flag with a worker's certificate, where `farm certificates` makes it, and a comment that
    says whose it is, if there are several.
    """
    names: tuple[str, ...] = ()
    with suppress(ConfigError):  # a learner at a router needs no list of its own
        names = bundle.roster().workers
    if not names:
        return ["--tls", "worker-NAME"], ["  # NAME: farm certificates add CERTS --worker NAME"]
    folder = Path("certs") if bundle.folder.is_absolute() else bundle.folder.parent
    others = [f"  # on {names[0]}; {', '.join(names[1:3])}{', ...' * (len(names) > 3)} likewise"]
    return ["--tls", str(folder / f"worker-{names[0]}")], others if len(names) > 1 else []


def how_to_resume(place: Placement, folder: Path) -> str:
    """The command with which a run in this folder continues, at the same place."""
    if place.workers:
        return f"farm run --resume {typed(folder)}"
    words = ["farm", "learner"]
    for router in place.connect:
        words += ["--connect", router]
    if not place.connect and place.listen != LISTEN:
        words += ["--listen", place.listen]
    if place.tls:
        words += ["--tls", str(place.tls.folder)]
    if place.trusted:
        words.append("--trust-network")
    if place.farm != "farm":
        words += ["--farm", place.farm]
    return shlex.join([*words, "--resume", str(folder)])


def _address(place: Placement) -> list[str]:
    farm = ["--farm", place.farm] if place.farm != "farm" else []
    return [
        *(word for each in place.connect or (place.listen,) for word in ("--connect", each)),
        *farm,
    ]


def _allowing(files: Iterable[object]) -> list[str]:
    return [word for file in files for word in ("--allow-file", str(file))]
