"""What a host with a certificate can send too much of, over TLS on loopback, and what a learner
notices of it.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hosts import host, placed, tls
from made import pole

import farm
from farm import fingerprint
from farm.net import codec, keys
from farm.net.messages import WorkRequest
from farm.net.session import connect, listen
from farm.net.tls import find
from learner.run.launch import open_run

pytestmark = pytest.mark.slow
ROOT, SILENT = Path(__file__).parents[2], 300


def test_zenoh_drops_requests_that_are_too_many_or_too_large(certs: Path) -> None:
    endpoint, key = tls(), keys.want("farm", "a/1")
    with listen(endpoint, "farm", find(certs, "learner")) as learner:
        learner.subscribe("want", keys.want("farm", "**"))
        with connect((endpoint,), None, lambda: False, find(certs, "worker", "a")) as host:
            host.publish(key, b"first")
            assert learner.events.get(10).payload == b"first"
            start, count = time.monotonic(), 0
            while time.monotonic() - start < 1.0:
                host.publish(key, b"x" * 100)
                count += 1
            seconds = time.monotonic() - start
            time.sleep(0.01)  # the filter's own pause, so that size alone can be the reason
            host.publish(key, b"y" * 70_000)
            time.sleep(0.01)
            host.publish(key, b"last")
            got = []
            while not got or got[-1].payload != b"last":
                got.append(learner.events.get(10))
    assert count > 10_000
    assert len(got) < 1100 * seconds
    assert max(len(event.payload) for event in got) == 100


@pytest.mark.parametrize("through", ["learner", "router"])
@pytest.mark.parametrize("what", ["requests", "many-results"])
def test_a_machine_that_floods_is_cut_off(
    certs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, what: str, through: str
) -> None:
    task, place, token = pole(tmp_path / "mine"), placed(certs), keys.worker_token("farm", "liar/0")
    endpoint = place.listen
    config = farm.configure(f"{task}:Pole", generations=10_000, pairs=15)
    with ExitStack() as stack:
        if through == "router":
            stack.enter_context(router(endpoint, certs))
            place = replace(place, connect=(endpoint,))
        run = stack.enter_context(open_run(config, tmp_path / "run", place))
        learning = run.learn()
        stack.enter_context(host(endpoint, certs, "a", task))
        viewer = stack.enter_context(connect((endpoint,), None, lambda: False, place.tls))
        stack.enter_context(
            connect((endpoint,), None, lambda: False, find(certs, "worker", "liar"))
        ).token(token)
        while not viewer.present(token, 1.0):
            pass
        attack = [
            str(ROOT / "benchmarks/floods.py"),
            "--attack",
            what,
            "--at",
            endpoint,
            str(certs),
        ]
        stack.enter_context(subprocess.Popen([sys.executable, *attack], stdin=subprocess.PIPE))
        while viewer.present(token, 1.0):
            next(learning)
        assert len(run.pool.workers) == 1  # the honest one
    assert "machine liar sends more than any worker" in caplog.text


@pytest.mark.parametrize("what", ["histories", "statuses", "token-queries", "subscriptions"])
def test_a_viewer_that_floods_is_cut_off_and_the_run_goes_on(
    certs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, what: str
) -> None:
    task = pole(tmp_path / "mine")
    place = placed(certs)
    config = farm.configure(f"{task}:Pole", generations=10_000, pairs=15)
    with ExitStack() as stack:
        run = stack.enter_context(open_run(config, tmp_path / "run", place))
        learning = run.learn()
        stack.enter_context(host(place.listen, certs, "a", task))
        next(learning)
        attack = ["benchmarks/floods.py", "--attack", what, "--at", place.listen, str(certs)]
        words = [sys.executable, *attack]
        stack.enter_context(subprocess.Popen(words, stdin=subprocess.PIPE, cwd=ROOT))
        while "machine looker sends more than any viewer" not in caplog.text:
            next(learning)
        for _ in range(10):
            next(learning)
        assert len(run.pool.workers) == 1


@contextmanager
def router(endpoint: str, certs: Path) -> Iterator[None]:
    words = [
        sys.executable,
        "-m",
        "farm",
        "router",
        "--listen",
        endpoint,
        "--tls",
        str(certs / "learner"),
    ]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


def test_results_larger_than_any_of_the_run_are_dropped_unread(certs: Path, tmp_path: Path) -> None:
    file, place = pole(tmp_path / "mine"), placed(certs)
    with open_run(
        farm.configure(f"{file}:Pole", generations=5000, pairs=15), tmp_path / "run", place
    ) as run:
        learning, key = run.learn(), keys.result("farm", "run", "silent/1")
        with (
            connect((place.listen,), None, lambda: False, find(certs, "worker", "silent")) as liar,
            host(place.listen, certs, "a", file),
        ):
            next(learning)
            liar.publish(key, b"x" * 20_000_000)
            liar.publish(key, b"small")
            next(learning)
            while not run.pool.notices.ignored["unasked"]:
                next(learning)
            assert run.pool.notices.ignored == {"unasked": 1}


@contextmanager
def silent_instances(endpoint: str, certs: Path) -> Iterator[None]:
    """Instances of one certificate that ask for jobs, and answer none."""
    stop, ready = threading.Event(), threading.Event()

    def ask() -> None:
        with connect((endpoint,), None, stop.is_set, find(certs, "worker", "silent")) as session:
            names = [f"silent/{i}" for i in range(SILENT)]
            for name in names:
                session.token(keys.worker_token("farm", name))
            while not stop.is_set():
                for name in names:
                    request = WorkRequest(
                        worker=name,
                        credits=128,
                        idle=(),
                        version=farm.__version__,
                        fingerprint=fingerprint.digest(),
                        host="silent",
                        cores=1,
                    )
                    session.publish(keys.want("farm", name), codec.encode(request))
                    stop.wait(0.002)
                ready.set()

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        assert ready.wait(60)
        yield
    finally:
        stop.set()
        thread.join(20)


def test_silent_instances_of_one_certificate_delay_no_round(certs: Path, tmp_path: Path) -> None:
    file, hashes, late = pole(tmp_path / "mine"), [], 0
    config = farm.configure(f"{file}:Pole", generations=200, pairs=15)
    for name in ("alone", "flooded"):
        place = placed(certs)
        with open_run(config, tmp_path / name, place) as run, host(place.listen, certs, "a", file):
            learning = run.learn()
            next(learning)
            if name == "alone":
                for _ in learning:
                    pass
            else:
                with silent_instances(place.listen, certs):
                    before = time.monotonic()
                    for _ in learning:
                        late += time.monotonic() - before > 0.8  # patience is 1 s
                        before = time.monotonic()
        hashes.append(run.summary["parameters_sha256"])
    assert hashes[0] == hashes[1]
    assert late <= 3, f"{late} of 199 rounds were late; a busy machine delays some"
