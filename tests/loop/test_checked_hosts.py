"""Answers of hosts that lie are checked, by a second host or by the learner's own machine, and
change no number.
"""

import re
import threading
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hosts import BOGUS, LIES, Forge, Late, file_of, finished, host, placed, refused, tls

import farm
from farm.net.messages import WorkRequest
from farm.net.session import listen
from farm.net.tls import find
from farm.net.work import Failure, Results
from learner.run import checkpoint as checkpoints
from learner.run.config import RunConfig
from learner.run.launch import open_run
from learner.run.states import RolledBack


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_the_learners_own_machine_decides_between_two_hosts(
    certs: Path,
    config: RunConfig,
    honest: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    lie: Forge,
) -> None:
    place, file = placed(certs, 1.0), file_of(config)
    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        for name, forge in (("liar", lie), ("a", lambda message: message)):
            hosts.enter_context(host(place.listen, certs, name, file, forge))
        assert finished(run) == honest
    assert "host liar gave different numbers than this machine" in caplog.text
    assert refused(caplog) == {"liar"}


def test_what_no_second_host_can_check_is_checked_before_the_result_is_final(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file = placed(certs), file_of(config)
    with (
        open_run(config, tmp_path / "honest-alone", place) as run,
        host(place.listen, certs, "a", file),
    ):
        assert finished(run) == honest
    assert run.summary["checks"] == {"a": 1}
    place = placed(certs)
    with (
        open_run(config, tmp_path / "liar-alone", place) as run,
        host(place.listen, certs, "liar", file, LIES["the last bit"]),
        pytest.raises(
            RolledBack, match="the run goes back to generation 0, before the first answer of"
        ),
    ):
        finished(run)
    assert run.summary["state"] == "interrupted"
    assert list(checkpoints.load(run.learner.folder.checkpoint).expelled) == ["liar"]
    with (
        open_run(config, tmp_path / "liar-alone", place, resume=True) as run,
        host(place.listen, certs, "a", file),
    ):
        assert finished(run) == honest


def test_a_mixed_run_says_which_host_nobody_can_check(
    certs: Path, config: RunConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def alone(message: Any) -> Any:
        return (
            replace(message, canary=BOGUS)
            if isinstance(message, WorkRequest)
            else LIES["the last bit"](message)
        )

    place, file = placed(certs, mixed=True), file_of(config)
    with (
        open_run(config, tmp_path / "r", place) as run,
        host(place.listen, certs, "liar", file, alone),
    ):
        finished(run)
    assert run.summary["checks"] == {"liar": 0}
    assert "the last answers of host liar are unchecked" in caplog.text


def test_hosts_that_only_say_that_jobs_fail_stop_no_run(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place, file, liars = placed(certs, 0.0), file_of(config), ("b", "c", "liar")
    failed, everywhere = defaultdict[int, set[str]](set), threading.Event()

    def failing(answer: Results) -> Failure:
        job = int(answer.jobs[0])
        failed[job].add(answer.worker)
        if len(failed[job]) == len(liars):
            everywhere.set()
        where = {
            "run": answer.run,
            "incarnation": answer.incarnation,
            "round": answer.round,
            "worker": answer.worker,
        }
        return Failure(**where, index=job, error="ValueError: made up")

    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        for name in liars:
            hosts.enter_context(host(place.listen, certs, name, file, Late(failing, 2)))
        with ThreadPoolExecutor(1) as pool:
            learnt = pool.submit(finished, run)
            assert everywhere.wait(30)
            hosts.enter_context(host(place.listen, certs, "a", file))
            assert learnt.result(60) == honest
    hits = (
        re.match(r"worker (\w+)/\S+ does not serve this run: it failed at job", line)
        for line in caplog.messages
    )
    assert {each[1] for each in hits if each} == set(liars)


def test_a_pool_checks_a_lone_host_before_it_gives_out_returns(
    certs: Path, config: RunConfig
) -> None:
    endpoint, file = tls(), file_of(config)
    with listen(endpoint, "farm", find(certs, "learner")), ExitStack() as hosts:
        pool = hosts.enter_context(farm.Farm(config.task, connect=endpoint, tls=certs))
        thetas = np.random.default_rng(0).normal(size=(5, pool.size))
        with farm.Farm(config.task, workers=1) as local:
            right = local.map(thetas, seeds=range(5))
        came = pool.imap(thetas, seeds=range(5))
        hosts.enter_context(host(endpoint, certs, "liar", file, LIES["the last bit"]))
        wrong = [next(came) for _ in range(5)]
        hosts.enter_context(host(endpoint, certs, "a", file))
        assert dict(came) == dict(enumerate(right.tolist())), "later returns count"
        assert all(value != right[index] for index, value in wrong)
        assert pool.map(thetas, seeds=range(5)).tobytes() == right.tobytes()
