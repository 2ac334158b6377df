"""What a host with a certificate can send too much of, and what that costs a run; one table.

    python benchmarks/floods.py [--generations 200] [--repeats 3] [--attacks results,connections]

A learner (`farm learner`, TLS, without recording) and one honest worker share the first core and
learn the gait; the attacker has the last core, from the second generation to the end. The columns:
time of a generation divided by that without an attack, median of turns; the learner's largest
memory; whether the run's hash is the same.
"""

import argparse
import itertools
import json
import os
import secrets
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from scaling import megabytes, pause, process, progress

import farm
from farm import fingerprint
from farm.commands import certificates
from farm.net import codec, keys
from farm.net.messages import WorkRequest
from farm.net.session import Session, connect, free_endpoint
from farm.net.tls import Role, find

HERE: Final = Path(__file__).resolve()
_THREADS: Final = 16
_HUGE: Final = 60_000_000  # [bytes]


def _requests(session: Session, _: str) -> None:
    """As many requests for work as the link takes."""
    while True:
        session.publish(keys.want("farm", "liar/1"), _want("liar/1"))


def _large_requests(session: Session, _: str) -> None:
    """Requests of 60 MB."""
    while True:
        session.publish(keys.want("farm", "liar/1"), secrets.token_bytes(1) * _HUGE)


def _results(session: Session, _: str) -> None:
    """Results of 60 MB, one after the other."""
    while True:
        session.publish(keys.result("farm", "run", "liar/1"), secrets.token_bytes(1) * _HUGE)


def _many_results(session: Session, _: str) -> None:
    """As many small results as the link takes."""
    while True:
        session.publish(keys.result("farm", "run", "liar/1"), b"x" * 2000)


def _some_results(session: Session, _: str) -> None:
    """600 small results per second."""
    while True:
        session.publish(keys.result("farm", "run", "liar/1"), b"x" * 2000)
        time.sleep(1 / 600)


def _instances(session: Session, _: str) -> None:
    """1000 instances that ask for jobs, and answer none (500 are admitted); 600 requests per
    second.
    """
    names = [f"liar/{i}" for i in range(1000)]
    for name in names:
        session.token(keys.worker_token("farm", name))
    while True:
        for name in names:
            session.publish(keys.want("farm", name), _want(name))
            time.sleep(1 / 600)


def _connections(_: Session, endpoint: str) -> None:
    """6000 connections that say nothing, opened again when the learner closes them."""
    host, port = endpoint.partition("/")[2].rsplit(":", 1)
    silent: list[socket.socket] = []
    while True:
        with suppress(OSError):
            silent.append(socket.create_connection((host, int(port)), timeout=1.0))
        if len(silent) >= 6000:
            silent.pop(0).close()


def _asking(ask: Callable[[], object]) -> None:
    """Ask from several threads, each again when it has its answer."""
    for _ in range(_THREADS - 1):
        threading.Thread(target=_ask_for_ever, args=(ask,), daemon=True).start()
    _ask_for_ever(ask)


def _ask_for_ever(ask: Callable[[], object]) -> None:
    """Ask again and again; runs in a thread."""
    while True:
        ask()


def _queries(session: Session, _: str) -> None:
    """A worker's certificate: queries for the specification, 16 at a time."""
    _asking(lambda: session.ask(keys.spec("farm", "run"), 1.0))


def _histories(session: Session, _: str) -> None:
    """A viewer's certificate: queries for all reports, 16 at a time."""
    _asking(lambda: session.ask(f"{keys.history('farm', 'run')}?from=1", 1.0))


def _statuses(session: Session, _: str) -> None:
    """A viewer's certificate: queries for the status, 16 at a time."""
    _asking(lambda: session.ask(keys.status("farm", "run"), 1.0))


def _token_queries(session: Session, _: str) -> None:
    """A viewer's certificate: queries for liveliness tokens, 16 at a time."""
    _asking(lambda: session.tokens(keys.learner_token("farm", "*"), 1.0))


def _subscriptions(session: Session, _: str) -> None:
    """A viewer's certificate: as many subscriptions as the link takes."""
    for number in itertools.count():
        session.subscribe("report", keys.report("farm", f"run-{number}"))


def _tokens(session: Session, _: str) -> None:
    """A worker's certificate: as many liveliness tokens as the link takes."""
    for number in itertools.count():
        session.token(keys.worker_token("farm", f"liar/{number}"))


VIEWERS: Final = ("histories", "statuses", "token-queries", "subscriptions")
"""Attacks with a viewer's certificate."""

ATTACKS: Final[dict[str, Callable[[Session, str], None]]] = {
    "requests": _requests,
    "large-requests": _large_requests,
    "results": _results,
    "many-results": _many_results,
    "some-results": _some_results,
    "instances": _instances,
    "connections": _connections,
    "queries": _queries,
    "histories": _histories,
    "statuses": _statuses,
    "token-queries": _token_queries,
    "subscriptions": _subscriptions,
    "tokens": _tokens,
}


def _want(worker: str) -> bytes:
    return codec.encode(
        WorkRequest(
            worker=worker,
            credits=128,
            idle=(),
            version=farm.__version__,
            fingerprint=fingerprint.digest(),
            host="liar",
            cores=1,
        )
    )


def _attack(kind: str, endpoint: str, certs: Path) -> None:
    """Attack until standard input ends."""
    role: Role = "viewer" if kind in VIEWERS else "worker"
    threading.Thread(target=lambda: (sys.stdin.read(), os._exit(0))).start()
    with connect(
        (endpoint,),
        20.0,
        lambda: False,
        find(certs, role, "looker" if role == "viewer" else "liar"),
    ) as session:
        ATTACKS[kind](session, endpoint)


def _run(kind: str | None, certs: Path, generations: int) -> tuple[float, float, str]:
    """Time per generation [s], the learner's largest memory [MB], and the hash of a run under an
    attack.
    """
    endpoint, tls = free_endpoint().replace("tcp/", "tls/"), ["--tls", str(certs)]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        words = [
            "-m",
            "farm",
            "learner",
            "--listen",
            endpoint,
            "--no-record",
            "--name",
            "run",
            *tls,
        ]
        words += ["--generations", str(generations), "--pairs", "15"]
        learner = stack.enter_context(process(words, folder))
        worker = ["-m", "farm", "worker", "--connect", endpoint, "--name", "honest", *tls]
        stack.enter_context(process(worker, folder))
        run, most = Path(folder, "runs/run"), 0.0
        while len(progress(run)) < 2:
            pause(learner)
        if kind is not None:
            flags = ["--attack", kind, "--at", endpoint, str(certs)]
            stack.enter_context(process([str(HERE), *flags], folder))
        start = time.monotonic()
        while learner.poll() is None:
            with suppress(OSError, IndexError):
                most = max(most, megabytes(learner.pid))
            pause()
        took = (time.monotonic() - start) / (generations - 2)
        summary = json.loads((run / "summary.json").read_text())
    return took, most, summary["parameters_sha256"]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--generations", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--attacks", default=",".join(ATTACKS))
    parser.add_argument("--attack", help=argparse.SUPPRESS)
    parser.add_argument("--at", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    # Children inherit it
    os.sched_setaffinity(0, {(os.cpu_count() or 1) - 1 if arguments.attack else 0})
    if arguments.attack:
        _attack(arguments.attack, arguments.at[0], Path(arguments.at[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        certs = Path(folder, "certs")
        words = ["--worker", "honest", "--worker", "liar", "--viewer", "looker"]
        certificates.main(["new", str(certs), "--learner", "127.0.0.1", *words])
        print("| attack | time of a generation | learner MB | same hash |\n|---|---|---|---|")
        for kind in arguments.attacks.split(","):
            turns = [
                (_run(None, certs, arguments.generations), _run(kind, certs, arguments.generations))
                for _ in range(arguments.repeats)
            ]
            ratio = statistics.median(under[0] / quiet[0] for quiet, under in turns)
            most = [max(turn[which][1] for turn in turns) for which in (0, 1)]
            same = len({hashed for turn in turns for _, _, hashed in turn}) == 1
            what = " ".join((ATTACKS[kind].__doc__ or "").split()).rstrip(".")
            memory = f"{most[1]:.0f} (alone {most[0]:.0f})"
            print(f"| {what} | {ratio:.2f} | {memory} | {'yes' if same else 'no'} |", flush=True)


if __name__ == "__main__":
    from running import script

    script(main)
