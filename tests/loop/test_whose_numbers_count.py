"""Hosts round alike or differently: whose numbers count, also where a host lies about its own."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hosts import BOGUS, file_of, finished, host, placed, refused, tls

from farm import fingerprint
from farm.net.messages import WorkRequest
from farm.net.session import listen
from farm.net.tls import find
from learner.pool.placement import Placement
from learner.run.config import RunConfig
from learner.run.launch import Run, open_run


def without_simulating(message: Any) -> Any:
    """Another fingerprint, and returns that are made up."""
    if isinstance(message, WorkRequest):
        return replace(message, fingerprint=BOGUS)
    return replace(message, returns=np.full_like(message.returns, 1000.0))


def admitted(run: Run) -> set[str]:
    return {worker.partition("/")[0] for worker in run.pool.workers}


def test_a_made_up_fingerprint_shuts_out_nobody(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place, file = placed(certs), file_of(config)
    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        for name in "ab":
            hosts.enter_context(host(place.listen, certs, name, file))
        assert finished(run) == honest
        assert admitted(run)
    assert refused(caplog) == {"liar"}
    assert run.learner.fingerprint == fingerprint.digest()


@pytest.mark.slow
def test_hosts_that_wait_at_a_router_are_not_shut_out(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint, bundle, file = tls(), find(certs, "learner"), file_of(config)
    place = Placement(connect=(endpoint,), tls=bundle)
    waiting = [
        host(endpoint, certs, "liar", file, without_simulating),
        *(host(endpoint, certs, n, file) for n in "ab"),
    ]
    with listen(endpoint, "farm", bundle), ExitStack() as hosts:
        # Each asks only when it has been idle for a while
        with ThreadPoolExecutor(len(waiting)) as together:
            list(together.map(hosts.enter_context, waiting))
        with open_run(config, tmp_path / "r", place) as run:
            assert finished(run) == honest
            assert admitted(run)
    assert refused(caplog) == {"liar"}


@pytest.mark.slow
def test_a_resumed_run_keeps_whose_numbers_count(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file = placed(certs), file_of(config)
    with (
        open_run(replace(config, generations=3), tmp_path / "r", place) as run,
        ExitStack() as hosts,
    ):
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        hosts.enter_context(host(place.listen, certs, "a", file))
        finished(run)
    place = placed(certs)
    with open_run(config, tmp_path / "r", place, resume=True) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "liar", file, without_simulating))
        hosts.enter_context(host(place.listen, certs, "b", file))
        assert finished(run) == honest
        assert admitted(run) == {"b"}
        assert run.learner.fingerprint == fingerprint.digest()


def test_the_user_may_say_whose_numbers_count(
    certs: Path, config: RunConfig, tmp_path: Path
) -> None:
    place, file = placed(certs, fingerprint=BOGUS[:8]), file_of(config)
    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.enter_context(host(place.listen, certs, "a", file))
        hosts.enter_context(
            host(
                place.listen,
                certs,
                "b",
                file,
                lambda s: replace(s, fingerprint=BOGUS) if isinstance(s, WorkRequest) else s,
            )
        )
        finished(run)
        assert admitted(run) == {"b"}
