"""Answers of hosts that lie are found by the checker, and change no number."""

import logging
import os
import re
import shlex
import signal
import sys
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hosts import (
    BOGUS,
    LIES,
    Forge,
    Late,
    file_of,
    finished,
    honest_answers,
    host,
    learnt,
    placed,
    refused,
    tls,
)

import farm
from farm.net.messages import WorkRequest
from farm.net.session import free_endpoint, listen
from farm.net.tls import find
from farm.net.work import Failure, Results
from learner.pool.placement import Placement
from learner.pool.scheduler import SchedulerConfig
from learner.run import checkpoint as checkpoints
from learner.run.config import RunConfig
from learner.run.launch import open_run
from learner.run.states import RolledBack

LIARS = [
    pytest.param(("liar", "a"), id="beside an honest one"),
    pytest.param(("liar", "b", "a"), id="two of three", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(
    "lie",
    [
        pytest.param(lie, id=name, marks=pytest.mark.slow if name != "the last bit" else ())
        for name, lie in LIES.items()
    ],
)
@pytest.mark.parametrize("names", LIARS)
def test_the_checker_is_right_against_any_number(
    certs: Path,
    config: RunConfig,
    honest: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    lie: Forge,
    names: Sequence[str],
) -> None:
    hosts = {name: honest_answers if name == "a" else lie for name in names}
    assert learnt(config, tmp_path / "r", certs, 1.0, hosts)[1] == honest
    for name in names[:-1]:
        assert f"host {name} gave other numbers than the checker" in caplog.text
    assert refused(caplog) == {*names[:-1]}


@pytest.mark.slow
@pytest.mark.parametrize("audit", [0.02, 1.0])
def test_every_host_is_checked_before_the_result_is_final(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path, audit: float
) -> None:
    run, value = learnt(config, tmp_path / "a", certs, audit, {"a": honest_answers})
    assert value == honest
    assert run.summary["checks"]["a"] > 0
    place = placed(certs, audit)
    file = file_of(config)
    lie = LIES["the last bit"]
    with (
        open_run(config, tmp_path / "liar", place) as run,
        host(place.listen, certs, "liar", file, lie),
        pytest.raises(
            RolledBack, match="the run goes back to generation 0, before the first answer of"
        ),
    ):
        finished(run)
    assert run.summary["state"] == "interrupted"
    assert list(checkpoints.load(run.learner.folder.checkpoint).expelled) == ["liar"]
    hosts = {"a": honest_answers}
    assert learnt(config, tmp_path / "liar", certs, audit, hosts, resume=True)[1] == honest


@pytest.mark.slow
def test_the_learners_own_workers_need_no_checker(
    config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place = Placement(workers=2, listen=free_endpoint(), scheduler=SchedulerConfig(audit=1.0))
    with open_run(config, tmp_path / "r", place) as run:
        for _ in run.learn():
            pass
        assert not [each for each in threading.enumerate() if each.name == "checker"]
    assert (run.summary["parameters_sha256"], run.summary["checks"]) == (honest, {})


@pytest.mark.slow
def test_a_checker_that_is_killed_loses_no_check(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    config = replace(config, generations=40)
    place = placed(certs, 1.0)
    file = file_of(config)
    killed = False
    with (
        open_run(config, tmp_path / "r", place) as run,
        host(place.listen, certs, "a", file),
    ):
        for _ in run.learn():
            pid = checking()
            if pid and not killed:
                os.kill(pid, signal.SIGKILL)
                killed = True
        assert killed or checking()
    assert run.summary["checks"]["a"] > 0
    assert run.summary["state"] == "finished"


def checking() -> int | None:
    """The id of the process that checks, a child of this one."""
    children = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    ids = " ".join(each.read_text() for each in children).split()
    words = {each: Path(f"/proc/{each}/cmdline").read_bytes() for each in ids}
    return next((int(each) for each, line in words.items() if b"runner_process" in line), None)


def test_what_the_named_machine_says_is_right(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    checker = f"env CHECKS=1 {shlex.quote(sys.executable)}"
    place = placed(certs, 1.0, checker=checker)
    file = file_of(config)
    with (
        open_run(config, tmp_path / "r", place) as run,
        host(place.listen, certs, "a", file),
    ):
        assert finished(run) == honest
    assert run.summary["checks"]["a"] > 0


@pytest.mark.slow
def test_a_mixed_run_says_which_host_nobody_can_check(
    certs: Path, config: RunConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def alone(message: Any) -> Any:
        return (
            replace(message, fingerprint=BOGUS)
            if isinstance(message, WorkRequest)
            else LIES["the last bit"](message)
        )

    place = placed(certs, any_rounding=True)
    file = file_of(config)
    with (
        open_run(config, tmp_path / "r", place) as run,
        host(place.listen, certs, "liar", file, alone),
    ):
        finished(run)
    assert run.summary["checks"] == {"liar": 0}
    assert "answers of host liar are not checked: the checker rounds differently" in caplog.text
    assert "--checker names a machine that can" in caplog.text


@pytest.mark.slow
def test_hosts_that_only_say_that_jobs_fail_stop_no_run(
    certs: Path, config: RunConfig, honest: str, tmp_path: Path
) -> None:
    place, file, liars = placed(certs, 0.0), file_of(config), ("b", "c", "liar")
    failed, everywhere = defaultdict[int, set[str]](set), threading.Event()
    lines = list[str]()
    declined = threading.Event()

    def notice(record: logging.LogRecord) -> bool:
        if "does not serve this run" in (line := record.getMessage()):
            lines.append(line)
        if len(lines) == len(liars):
            declined.set()
        return True

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

    notices = logging.getLogger("learner.pool.pool")
    notices.addFilter(notice)
    with open_run(config, tmp_path / "r", place) as run, ExitStack() as hosts:
        hosts.callback(notices.removeFilter, notice)
        for name in liars:
            hosts.enter_context(host(place.listen, certs, name, file, Late(failing, 2)))
        with ThreadPoolExecutor(1) as pool:
            learnt = pool.submit(finished, run)
            assert everywhere.wait(30)
            assert declined.wait(30)
            hosts.enter_context(host(place.listen, certs, "a", file))
            assert learnt.result(60) == honest
    hits = (
        re.match(r"worker (\w+)/\S+ does not serve this run: it failed at job", line)
        for line in lines
    )
    assert {each[1] for each in hits if each} == set(liars)


@pytest.mark.slow
def test_a_pool_checks_a_host_before_it_gives_out_returns(certs: Path, config: RunConfig) -> None:
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
