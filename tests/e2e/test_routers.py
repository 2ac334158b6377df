"""Routers between learner and workers: zenohd instead of ours, and one router per site."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import SMALL, Farm

from farm.commands import certificates
from farm.net import keys
from farm.net.session import connect, free_endpoint
from farm.net.tls import find

pytestmark = pytest.mark.slow


@pytest.fixture
def learns(farm: Farm, reference: dict[str, Any]) -> Callable[..., None]:
    """Ten generations by a learner that connects to one router and workers that connect to another,
    or the same.
    """

    def run(learner: list[str], worker: list[str]) -> None:
        farm.start("worker", "--workers", "2", *worker)
        certificate = find(Path(learner[-1]), "learner") if "--tls" in learner else None
        with connect((worker[1],), 60.0, lambda: False, certificate) as session:
            # Ten generations are over soon
            while len(session.tokens(keys.worker_token("farm", "**"), 1.0)) < 2:
                pass
        farm.call("learner", "--name", "r", "--generations", "10", *SMALL, *learner)
        summary = farm.summary("r")
        assert summary["workers"] == 2
        assert summary["parameters_sha256"] == reference["parameters_sha256"]

    return run


def test_one_router(farm: Farm, learns: Callable[..., None]) -> None:
    endpoint = free_endpoint()
    farm.start_router(endpoint, zenohd=True)
    learns(["--connect", endpoint], ["--connect", endpoint])


@pytest.mark.parametrize(
    ("encrypted", "zenohd"),
    [(True, False), (False, True), (True, True)],
    ids=["tls-ours", "tcp-zenohd", "tls-zenohd"],
)
def test_two_sites(
    farm: Farm, tmp_path: Path, learns: Callable[..., None], encrypted: bool, zenohd: bool
) -> None:
    """The learner at one site, workers at the other.

    The second site's router is there first, and tries until then.
    """
    here, remote, learner, worker = free_endpoint(), free_endpoint(), [], []
    if encrypted:
        certificates.main(
            ["new", str(tmp_path / "certs"), "--learner", "127.0.0.1", "--worker", "w"]
        )
        learner, worker = (
            ["--tls", str(tmp_path / "certs" / name)] for name in ("learner", "worker-w")
        )
        here, remote = here.replace("tcp", "tls"), remote.replace("tcp", "tls")
    farm.start_router(remote, "--connect", here, *learner, zenohd=zenohd)
    farm.start_router(here, *learner, zenohd=zenohd)
    learns(["--connect", here, *learner], ["--connect", remote, *worker])


def test_a_router_that_joins_checks_where(farm: Farm) -> None:
    output = farm.call(
        "router", "--listen", free_endpoint(), "--connect", "elsewhere:7447", status=2
    )
    assert "endpoint 'elsewhere:7447' is not of the form tcp/HOST:PORT" in output
