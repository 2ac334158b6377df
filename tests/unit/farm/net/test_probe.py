"""Why a learner does not answer: a closed port, a wrong authority and a wrong host name are told
apart.
"""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from farm.commands import certificates
from farm.errors import ConfigError, FarmError
from farm.net import probe
from farm.net.session import connect, free_endpoint, listen
from farm.net.tls import Bundle, find

pytest.importorskip("cryptography")
EXPIRED = -0.001
"""Days: a certificate's times are whole seconds, so that one of 0 days is valid for a moment."""


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two authorities, and an expired worker.

    The first learner's certificate is for one host name and address.
    """
    folder = tmp_path_factory.mktemp("certificates")
    hosts = ("--learner", "127.0.0.1")
    certificates.main(["new", str(folder / "own"), *hosts, "--worker", "w1"])
    certificates.main(["new", str(folder / "foreign"), *hosts, "--worker", "w1"])
    authority = certificates.Authority.load(folder / "own" / "ca")
    authority.issue(folder / "own" / "worker-old", "worker", "old", EXPIRED, ())
    authority.issue(folder / "own" / "late", "learner", "learner", EXPIRED, ("127.0.0.1",))
    for each in ("late", "worker-w1"):
        (folder / "own" / each / "roster.json").write_bytes(
            (folder / "own" / "ca" / "roster.json").read_bytes()
        )
    return folder


@pytest.fixture
def learner(certs: Path) -> Iterator[str]:
    """Where a learner with certificates listens."""
    endpoint = tls()
    with listen(endpoint, "farm", find(certs / "own", "learner")):
        yield endpoint


def tls() -> str:
    return free_endpoint().replace("tcp/", "tls/")


@pytest.mark.slow
def test_a_good_certificate_gets_through(learner: str, certs: Path) -> None:
    assert probe.reason(learner, find(certs / "own", "worker", "w1")) == ""


def test_a_closed_port(certs: Path) -> None:
    endpoint = tls()
    for bundle in (None, find(certs / "own", "worker", "w1")):
        reason = probe.reason(endpoint, bundle)
        assert (
            reason == f"nothing listens on port {endpoint.rpartition(':')[2]} of 127.0.0.1; start a"
            " learner there (it listens after its pilot), or check --connect"
        )


def test_a_name_of_no_host() -> None:
    reason = probe.reason("tcp/no-such-host.invalid:7447")
    assert reason == "the host name no-such-host.invalid is unknown here; check --connect"


def test_an_authority_of_others(learner: str, certs: Path) -> None:
    reason = probe.reason(learner, find(certs / "foreign", "worker", "w1"))
    assert reason.startswith(
        f"its certificate is of another authority than {certs}/foreign/worker-w1/ca.pem"
    )


def test_a_host_name_that_is_not_in_the_certificate(learner: str, certs: Path) -> None:
    reason = probe.reason(
        learner.replace("127.0.0.1", "localhost"), find(certs / "own", "worker", "w1")
    )
    assert reason.startswith("its certificate is not for the host name localhost")
    assert "farm certificates renew CERTS --learner localhost" in reason


def test_our_certificate_is_refused(learner: str, certs: Path) -> None:
    """By the listener: we trust its authority, but it does not trust ours, or ours has expired."""
    mixed = certs / "mixed"
    if not mixed.exists():
        mixed.mkdir()
        for source, name in (("own", "ca.pem"), ("foreign", "cert.pem"), ("foreign", "key.pem")):
            (mixed / name).write_bytes((certs / source / "worker-w1" / name).read_bytes())
    reason = probe.reason(learner, Bundle(mixed, "worker", "w1"))
    assert reason.startswith(f"it refuses the certificate of worker w1 in {mixed}")
    reason = probe.reason(learner, Bundle(certs / "own" / "worker-old", "worker", "old"))
    assert reason.startswith(
        f"it refuses the certificate of worker old in {certs}/own/worker-old: expired"
    )


def test_a_listener_with_an_expired_certificate_or_a_workers(certs: Path) -> None:
    bundle = find(certs / "own", "worker", "w1")
    for folder, words in (
        ("late", "the learner's certificate has expired"),
        ("worker-w1", "is not a learner's"),
    ):
        endpoint = tls()
        with listen(endpoint, "farm", Bundle(certs / "own" / folder, "learner", "learner")):
            assert words in probe.reason(endpoint, bundle)


@pytest.mark.slow
def test_something_that_speaks_no_tls(certs: Path) -> None:
    endpoint = free_endpoint()
    with listen(endpoint, "farm"):
        reason = probe.reason(endpoint.replace("tcp/", "tls/"), find(certs / "own", "worker", "w1"))
    assert reason == (
        f"what listens there has no certificates: --connect {endpoint} without --tls, or start the"
        f" learner with --listen tls/0.0.0.0:{endpoint.rpartition(':')[2]} --tls CERTS/learner"
    )


def test_something_that_wants_certificates(learner: str) -> None:
    assert probe.reason(learner.replace("tls/", "tcp/")) == (
        f"what listens there wants certificates: --connect {learner} --tls FOLDER, this machine's"
        " folder that farm certificates made (worker-NAME)"
    )


@pytest.mark.slow
def test_something_without_certificates_that_should_have_none() -> None:
    endpoint = free_endpoint()
    with listen(endpoint, "farm"):
        assert probe.reason(endpoint) == ""


@pytest.mark.slow
def test_the_reason_is_in_the_message(learner: str, certs: Path) -> None:
    bundle = find(certs / "foreign", "worker", "w1")
    with pytest.raises(
        FarmError, match=r"no answer from tls/.* after 0 s: its certificate is of another authority"
    ):
        with connect((learner,), 0.0, lambda: False, bundle):
            pass
    closed = free_endpoint()
    with pytest.raises(
        FarmError,
        match=rf"{closed}: nothing listens .*; tcp/no.invalid:1: the host name no.invalid",
    ):
        with connect((closed, "tcp/no.invalid:1"), 0.0, lambda: False):
            pass


@pytest.mark.slow
def test_a_silent_port_is_told_from_a_closed_one() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        assert probe.reason(f"tcp/127.0.0.1:{silent.getsockname()[1]}") == ""


def test_an_expired_bundle_is_named_at_once(certs: Path) -> None:
    words = (
        r"the certificate of worker old in .* expired on 20\d\d-\d\d-\d\d: farm certificates renew"
        r" CERTS --worker old"
    )
    with pytest.raises(ConfigError, match=words):
        find(certs / "own", "worker", "old")


def test_a_bundle_of_another_role_says_how_to_get_one(certs: Path) -> None:
    folder = certs / "own"
    remedy = "farm certificates add CERTS --viewer NAME makes one, in CERTS/viewer-NAME"
    for role in ("learner", "worker-w1"):
        with pytest.raises(ConfigError, match=f"a viewer's is needed here: {remedy}"):
            find(folder / role, "viewer")
    with pytest.raises(
        ConfigError,
        match=f"{folder} holds no viewer's certificate: farm certificates add {folder} --viewer",
    ):
        find(folder, "viewer")
