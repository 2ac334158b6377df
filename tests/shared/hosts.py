"""Hosts with certificates, on threads of this process: honest ones and some that lie, over TLS on
loopback.
"""

import hashlib
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from farm.errors import MessageError
from farm.net import codec
from farm.net.messages import WorkRequest
from farm.net.session import Session, connect, free_endpoint
from farm.net.tls import find
from farm.net.work import Results
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run.config import RunConfig
from learner.run.launch import Run, open_run
from learner.run.states import RolledBack
from workers.config import WorkerConfig
from workers.worker import Worker

HOSTS = ("a", "b", "c", "silent", "liar")
BOGUS = hashlib.sha256(b"made up").hexdigest()
"""A fingerprint that no machine has."""
Forge = Callable[[Any], Any]


class Forging:
    """A session whose requests and results are changed on their way out; `sent` is set by the first
    one.
    """

    def __init__(self, session: Session, forge: Forge) -> None:
        self._session, self._forge, self.sent = session, forge, threading.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)

    def publish(self, key: str, payload: bytes, **how: bool) -> None:
        for kind in (WorkRequest, Results):
            with suppress(MessageError):
                payload = codec.encode(self._forge(codec.decode(payload, kind)))
                break
        self._session.publish(key, payload, **how)
        self.sent.set()


@contextmanager
def host(
    endpoint: str, certs: Path, name: str, file: Path, forge: Forge = lambda message: message
) -> Iterator[None]:
    """A host with this certificate, on a thread; it has asked for work when this returns."""
    config = WorkerConfig(connect=(endpoint,), tls=certs, name=name, allow_file=(file,))
    stop, request, failed = threading.Event(), threading.Event(), list[BaseException]()

    def serve() -> None:
        try:
            with connect(config.connect, None, stop.is_set, config.bundle) as session:
                forging = Forging(session, forge)
                worker = Worker(config, forging)  # type: ignore[arg-type]
                worker.join()
                while not stop.is_set():
                    worker.turn()
                    if forging.sent.is_set():
                        request.set()
        except BaseException as error:
            failed.append(error)
            request.set()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        assert request.wait(30)
        assert not failed, failed
        yield
    finally:
        stop.set()
        thread.join(20)


def tls() -> str:
    return free_endpoint().replace("tcp/", "tls/")


def placed(certs: Path, audit: float = 0.02, **more: Any) -> Placement:
    """Where a run is whose learner has these certificates, and the share of its jobs that are
    checked.
    """
    scheduler = SchedulerConfig(audit=audit)
    return Placement(listen=tls(), tls=find(certs, "learner"), scheduler=scheduler, **more)


def finished(run: Run) -> str:
    """Learn to the end; the hash."""
    for _ in run.learn():
        pass
    assert run.summary["state"] == "finished"
    return run.summary["parameters_sha256"]


def learnt(
    config: RunConfig,
    path: Path,
    certs: Path,
    audit: float,
    hosts: Mapping[str, Forge],
    *,
    resume: bool = False,
) -> tuple[Run, str]:
    """A run by these hosts, each with what it makes of its messages, and its hash; it goes back and
    continues as the command does.
    """
    while True:
        place = placed(certs, audit)
        file = file_of(config)
        with open_run(config, path, place, resume=resume) as run, ExitStack() as stack:
            for name, forge in hosts.items():
                stack.enter_context(host(place.listen, certs, name, file, forge))
            with suppress(RolledBack):
                return run, finished(run)
        resume = True


def honest_answers(message: Any) -> Any:
    """Change nothing."""
    return message


def file_of(config: RunConfig) -> Path:
    return Path(config.task.rpartition(":")[0])


def refused(caplog: pytest.LogCaptureFixture) -> set[str]:
    """Hosts that the learner refused."""
    matches = (re.match(r"worker (\w+)/\S+ is refused", line) for line in caplog.messages)
    return {each[1] for each in matches if each}


def shifted(change: Callable[[np.ndarray], np.ndarray]) -> Forge:
    return lambda message: (
        message
        if isinstance(message, WorkRequest)
        else replace(message, returns=change(message.returns))
    )


LIES = {
    "the last bit": shifted(lambda values: np.nextafter(values, np.inf)),
    "one percent": shifted(lambda values: 0.99 * values),
}


class Late:
    """Results that are changed from the `begin`th on, if `which` says so."""

    def __init__(
        self, lie: Forge, start: int, which: Callable[[int], bool] = lambda _: True
    ) -> None:
        self.lie, self.start, self.which, self.sent = lie, start, which, 0

    def __call__(self, message: Any) -> Any:
        if isinstance(message, Results):
            self.sent += 1
            if self.sent >= self.start and self.which(self.sent):
                return self.lie(message)
        return message
