"""With certificates only permitted programs connect, and each can do only what its certificate
permits.
"""

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest
from processes import SMALL, Farm
from recordings import generations

from farm.commands import certificates
from farm.errors import ConfigError, FarmError
from farm.net import codec, keys, session
from farm.net.messages import WorkRequest
from farm.net.session import Session, free_endpoint
from farm.net.tls import Bundle, find
from farm.net.work import Jobs, Results, Simulated

pytestmark = [pytest.mark.slow, pytest.mark.timeout(120)]


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with a learner, two workers and a viewer; a foreign one; and an expired
    worker.
    """
    folder = tmp_path_factory.mktemp("certificates")
    hosts = ("--learner", "127.0.0.1", "--learner", "localhost")
    certificates.main(
        ["new", str(folder / "own"), *hosts, "--worker", "w1", "--worker", "w2", "--viewer", "eva"]
    )
    certificates.main(["new", str(folder / "foreign"), *hosts, "--worker", "w1"])
    authority = certificates.Authority.load(folder / "own" / "ca")
    # A certificate of 0 days is valid until its second is over
    authority.issue(folder / "own" / "worker-old", "worker", "old", -0.001, ())
    return folder


@pytest.fixture(params=["learner", "router", "zenohd"])
def place(farm: Farm, certs: Path, request: pytest.FixtureRequest) -> tuple[str, list[str]]:
    """Where to connect, and the learner's flags: each topology gets the same attacks."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    tls = ["--tls", str(certs / "own")]
    if request.param == "learner":
        return endpoint, ["--listen", endpoint, *tls]
    farm.start_router(endpoint, *tls, zenohd=request.param == "zenohd")
    return endpoint, ["--connect", endpoint, *tls]


def never() -> bool:
    return False


@contextlib.contextmanager
def intruder(endpoint: str, bundle: Bundle) -> Iterator[Session]:
    with session.connect((endpoint,), 5, never, bundle) as opened:
        yield opened


def lie(worker: str, run: str, incarnation: str, round_: int, count: int) -> Results:
    """Very high returns for every pair."""
    eps = np.zeros((count, 1))
    flags = np.tile([True, False, False, False], (2 * count, 1))
    simulated = Simulated(
        returns=np.full(2 * count, 1000.0),
        flags=flags,
        steps=np.full(2 * count, 15),
        traces=np.zeros((2, 15, 54), dtype="<f4"),
        trajectories=(),
    )
    jobs = Jobs.exploring(eps, (1, -1), None)
    return Results.carrying(
        simulated, jobs, run=run, incarnation=incarnation, round=round_, worker=worker
    )


def test_intruders_do_nothing_and_honest_workers_do_not_notice(
    farm: Farm, certs: Path, place: tuple[str, list[str]], reference: dict[str, object]
) -> None:
    endpoint, learner_flags = place
    folder = certs / "own"
    learner = farm.start("learner", "--name", "r", "--generations", "10", *SMALL, *learner_flags)
    farm.wait_for(lambda: (farm.folder / "runs/r/checkpoint").exists())
    watched = find(folder, "worker", "w2")
    with (
        intruder(endpoint, watched) as w2,
        intruder(endpoint, find(folder, "viewer", "eva")) as eva,
    ):
        w2.subscribe("generation", keys.generation("farm", "r"))
        w2.subscribe("stolen", keys.inbox("farm", "w1/**"))
        for posing in (w2, eva):
            posing.token(keys.worker_token("farm", "w1/1-abc"))
            want = WorkRequest(
                worker="w1/1-abc",
                credits=100,
                idle=("r",),
                version="0",
                fingerprint="c",
                host="h",
                cores=2,
            )
            posing.publish(keys.want("farm", "w1/1-abc"), codec.encode(want))
        farm.start(
            "worker",
            "--connect",
            endpoint,
            "--tls",
            str(folder),
            "--name",
            "w1",
            "--workers",
            "2",
        )
        topics = []
        while learner.poll() is None:
            with contextlib.suppress(Exception):
                event = w2.events.get(timeout=0.2)
                topics.append(event.topic)
                header = json_of(event.payload)
                false = lie("w1/1-abc", "r", header["incarnation"], header["round"], 6)
                for liar in (w2, eva):
                    liar.publish(keys.result("farm", "r", "w1/1-abc"), codec.encode(false))
    output, _ = learner.communicate(timeout=60)
    assert learner.returncode == 0, output
    assert "generation" in topics, "the intruder was in a position to lie"
    assert "stolen" not in topics, "jobs for another worker were read"
    assert "1-abc" not in output, "nothing of the intruders' got through"
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]


def test_a_worker_cannot_pose_as_a_learner(
    farm: Farm, certs: Path, place: tuple[str, list[str]], reference: dict[str, object]
) -> None:
    endpoint, learner_flags = place
    folder, lie, request = certs / "own", b"a lie", keys.want("farm", "w2/1")
    learner = farm.start("learner", "--name", "r", "--generations", "10", *SMALL, *learner_flags)
    farm.wait_for(lambda: (farm.folder / "runs/r/checkpoint").exists())
    with (
        intruder(endpoint, find(folder, "worker", "w2")) as w2,
        intruder(endpoint, find(folder, "learner")) as witness,
    ):
        witness.subscribe("heard", "farm/**")
        witness.watch("token", "farm/live/**")
        w2.token(keys.learner_token("farm", "fake"))
        w2.token(keys.worker_token("farm", "w1/fake"))
        w2.answer(keys.spec("farm", "r"), lambda: lie)
        for key in (
            keys.generation("farm", "r"),
            keys.generation("farm", "*"),
            keys.report("farm", "r"),
            keys.history("farm", "r"),
            keys.inbox("farm", "w1/1"),
            keys.inbox("farm", "**"),
            keys.refused("farm", "w1/1"),
            keys.refused("farm", "**"),
            keys.want("farm", "**"),
            keys.want("farm", "w1/1"),
            keys.result("farm", "r", "**"),
            keys.result("farm", "r", "w1/1"),
            "farm/**",
            "**",
        ):
            w2.publish(key, lie)
        names = []

        def last_is_heard() -> bool:
            # This one may, and comes after all others; Zenoh drops it if it comes too soon
            w2.publish(request, lie)
            for event in witness.events.waiting(0.1):
                # The learner may begin its first round meanwhile
                if event.topic == "token" or event.payload == lie:
                    names.append(event.key)
            return request in names

        farm.wait_for(last_is_heard)
        assert {key for key in names if "live" not in key} == {request}
        assert not [key for key in names if "fake" in key]
        worker = farm.start(
            "worker",
            "--connect",
            endpoint,
            "--tls",
            str(folder),
            "--name",
            "w1",
            "--workers",
            "1",
        )
        output, _ = learner.communicate(timeout=60)
    assert learner.returncode == 0, output
    worker.terminate()
    assert "ignored" not in worker.communicate(timeout=20)[0]
    assert farm.summary("r")["parameters_sha256"] == reference["parameters_sha256"]


def test_a_viewer_records_and_a_worker_cannot_look(
    farm: Farm, certs: Path, place: tuple[str, list[str]]
) -> None:
    endpoint, learner_flags = place
    folder = certs / "own"
    learner = farm.start("learner", "--name", "r", "--generations", "5", *SMALL, *learner_flags)
    recorder = farm.start("record", "--connect", endpoint, "--tls", str(folder), "--name", "eva")
    assert recorder.stdout
    assert any("recording run r" in line for line in iter(recorder.stdout.readline, ""))
    with intruder(endpoint, find(folder, "worker", "w2")) as w2:
        w2.subscribe("report", keys.report("farm", "*"))
        w2.subscribe("history", keys.history("farm", "*"))
        assert w2.ask(keys.history("farm", "r"), 1.0) is None
        farm.start(
            "worker",
            "--connect",
            endpoint,
            "--tls",
            str(folder),
            "--name",
            "w1",
            "--workers",
            "1",
        )
        output, _ = learner.communicate(timeout=60)
        assert learner.returncode == 0, output
        assert not len(w2.events)
    output, _ = recorder.communicate(timeout=60)
    assert recorder.returncode == 0, output
    assert generations(farm.folder / "recordings/r/run.rrd") == [1, 2, 3, 4, 5]


def json_of(payload: bytes) -> dict[str, object]:
    return msgpack.unpackb(payload, ext_hook=lambda *_: None)


@pytest.mark.parametrize("kind", ["none", "foreign", "expired", "plain"])
def test_a_worker_without_a_good_certificate_is_told_what_to_check(
    farm: Farm, certs: Path, place: tuple[str, list[str]], kind: str
) -> None:
    endpoint, learner_flags = place
    farm.start("learner", "--name", "r", *SMALL, *learner_flags)
    farm.wait_for(lambda: (farm.folder / "runs/r/checkpoint").exists())
    if kind == "plain":
        with (
            pytest.raises(FarmError, match="no answer from"),
            session.connect((endpoint.replace("tls/", "tcp/"),), 2, never) as opened,
        ):
            refused(opened)
        return
    bundle = {
        "none": Naked(certs / "own" / "worker-w1", "worker", "w1"),
        "foreign": find(certs / "foreign", "worker", "w1"),
        # `find` refuses it at once
        "expired": Bundle(certs / "own" / "worker-old", "worker", "old"),
    }[kind]
    words = {
        "none": "no answer from",
        "foreign": "of another authority",
        "expired": "refuses the certificate .* expired",
    }
    with pytest.raises(FarmError, match=words[kind]):
        with session.connect((endpoint,), 2, never, bundle) as opened:
            refused(opened)


class Naked(Bundle):
    """Settings that trust the farm's authority, but have no certificate."""

    def settings(self, side: str) -> dict[str, object]:
        assert side == "connect"
        return {"transport/link/tls/root_ca_certificate": str(self.folder / "ca.pem")}


def refused(opened: Session) -> None:
    """A session that was opened nevertheless must be useless."""
    until = time.monotonic() + 3
    while time.monotonic() < until:
        assert opened.ask(keys.generation("farm", "r"), 0.5) is None
    raise FarmError("no answer from: of another authority, or it refuses the certificate: expired")


def test_a_bundle_serves_its_role_only(certs: Path) -> None:
    with pytest.raises(ConfigError, match="is the bundle of a viewer; a worker's is needed here"):
        find(certs / "own" / "viewer-eva", "worker")
    with pytest.raises(
        ConfigError,
        match="holds certificates for these workers: old, w1, w2; choose one with --name",
    ):
        find(certs / "own", "worker")
    with pytest.raises(ConfigError, match="has no list of machines"):
        Bundle(certs / "own" / "worker-w1", "learner", "w1").roster()


def test_keys_are_kept_private(certs: Path) -> None:
    for key in certs.rglob("key.pem"):
        assert key.stat().st_mode & 0o077 == 0


def test_configuration_for_zenohd(farm: Farm, certs: Path) -> None:
    output = farm.call(
        "router", "--print-config", "--listen", "tls/0.0.0.0:7447", "--tls", str(certs / "own")
    )
    config = json.loads(output)
    assert config["mode"] == "router"
    assert config["access_control"]["default_permission"] == "deny"
    assert config["transport"]["link"]["tls"]["enable_mtls"] is True
