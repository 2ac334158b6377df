"""`farm status`, and refused workers."""

import json

import pytest
from processes import SMALL, Farm

from farm.net import codec, keys
from farm.net.session import free_endpoint, listen
from farm.net.telemetry import RunStatus, WorkerStatus

pytestmark = pytest.mark.slow


def test_runs_and_workers_are_seen(farm: Farm) -> None:
    endpoint = free_endpoint()
    farm.start("learner", "--name", "r", "--generations", "100000", "--listen", endpoint, *SMALL)
    farm.start("worker", "--connect", endpoint, "--workers", "2")
    farm.wait_for(lambda: len(farm.progress("r")) > 20)
    (run,) = json.loads(farm.call("status", "--connect", endpoint, "--json"))
    assert run["run"] == "r"
    assert 0 < run["generation"] <= run["generations"] == 100000
    assert len(run["workers"]) == 2
    assert all(worker["rollouts"] > 0 and worker["rate"] > 0 for worker in run["workers"])
    assert run["ignored"].keys() <= {
        "stale",
        "doubled",
    }, "copies of jobs that took long on a busy machine"
    assert all(worker["ignored"].keys() <= {"stale"} for worker in run["workers"])
    output = farm.call("status", "--connect", endpoint)
    assert "100000" in output
    assert "workers" in output


STATUS = RunStatus(
    run="r",
    generation=1,
    generations=2,
    return_mean=None,
    mean_policy_return=None,
    open=0,
    reissued=0,
    refused=0,
    ignored={},
    workers=(
        WorkerStatus(
            worker="w/12345-abcdef",
            host="[/red]",
            cores=2,
            version="[bold]",
            fingerprint="c",
            rollouts=1,
            rate=1.0,
            seen=0.0,
            ignored={"stale": 7},
        ),
    ),
    fingerprint="ab" * 32,
)


def test_learners_of_another_release(farm: Farm) -> None:
    endpoint = free_endpoint()
    with listen(endpoint, "farm") as session:
        session.answer(keys.status("farm", "r"), lambda: codec.encode(STATUS, codec.SCHEMA + 1))
        output = farm.call("status", "--connect", endpoint, status=1)
    versions = f"schema version {codec.SCHEMA + 1}, this side has {codec.SCHEMA}"
    assert f"a learner answers, but its message cannot be read: {versions}" in output


def test_no_learner(farm: Farm) -> None:
    endpoint = free_endpoint()
    output = farm.call("status", "--connect", endpoint, "--timeout", "1", status=1)
    assert f"no answer from {endpoint}" in output


def test_status_fails_when_the_named_run_or_worker_is_missing(farm: Farm) -> None:
    endpoint = free_endpoint()
    farm.start("learner", "--name", "r", "--generations", "100000", "--listen", endpoint, *SMALL)
    farm.start("worker", "--connect", endpoint, "--workers", "1", "--name", "w")
    farm.wait_for(lambda: farm.progress("r"))
    words = ("status", "--connect", endpoint)
    farm.call(*words, "--run", "r", "--worker", "w")
    assert "no learner of run s answers on this farm" in farm.call(*words, "--run", "s", status=1)
    near = farm.call(*words, "--run", "rr", status=1)
    assert near.endswith("answers on this farm; did you mean r?\n")
    assert "no worker v is on this farm" in farm.call(*words, "--worker", "v", status=1)


def test_a_worker_with_other_code_serves_nothing_and_both_sides_say_so(farm: Farm) -> None:
    endpoint = free_endpoint()
    learner = farm.start(
        "learner", "--name", "r", "--generations", "5", "--listen", endpoint, *SMALL
    )
    code = (
        "import sys; from farm import plugins; plugins.code_digest = lambda module: 'x';"
        "from workers.__main__ import main;"
        f"sys.exit(main(['--connect', '{endpoint}']))"
    )
    stranger = farm.start_python("-c", code)
    assert stranger.stdout
    lines = iter(stranger.stdout.readline, "")
    line = next(line for line in lines if "cannot serve" in line)
    reason = (
        "its code of 'finger-gait' differs from the learner's: install the learner's release on"
        " both sides"
    )
    assert f"cannot serve run r: {reason}" in line

    # Until it has read the spec, and its words have reached the learner, it is a worker like others
    def refused() -> bool:
        (run,) = json.loads(farm.call("status", "--connect", endpoint, "--json"))
        assert all(worker["rollouts"] == 0 for worker in run["workers"])
        return run["refused"] == 1 and run["workers"] == []

    farm.wait_for(refused)
    farm.start("worker", "--connect", endpoint, "--workers", "1")
    output, _ = learner.communicate(timeout=60)
    assert learner.returncode == 0, output
    assert output.count(f"does not serve this run: {reason}") == 1
