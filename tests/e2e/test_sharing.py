"""Runs that share their workers, and a run without workers for some time."""

import os
import time
from pathlib import Path

import pytest
from processes import SMALL, Farm, children

from farm.commands.status import ask
from farm.net.session import connect, free_endpoint

pytestmark = pytest.mark.slow

GENERATIONS = 60
RUNS = {
    "first": ("--seed", "1"),
    "second": ("--seed", "2", "--policy", "projected", "--features", "50"),
}


def test_two_runs_get_equal_shares_of_the_workers(farm: Farm) -> None:
    """While both run, each makes more than half of the other's generations, and both have the usual
    numbers.
    """
    endpoint, length = free_endpoint(), ("--generations", str(GENERATIONS), *SMALL)
    farm.start_router(endpoint)
    learners = {
        name: farm.start("learner", "--name", name, "--connect", endpoint, *flags, *length)
        for name, flags in RUNS.items()
    }
    with connect((endpoint,), 30.0, lambda: False) as link:
        farm.wait_for(lambda: len(ask(link, "farm")) == len(RUNS))
    farm.start("worker", "--connect", endpoint, "--workers", "2")
    farm.wait_for(lambda: max(len(farm.progress(name)) for name in RUNS) >= GENERATIONS - 1, 120)
    done = sorted(len(farm.progress(name)) for name in RUNS)
    assert done[0] > GENERATIONS / 2, f"generations done: {done}"
    for name, learner in learners.items():
        assert learner.wait(120) == 0
        farm.call("run", "--name", f"{name}-alone", *RUNS[name], *length)
        assert (
            farm.summary(name)["parameters_sha256"]
            == farm.summary(f"{name}-alone")["parameters_sha256"]
        )


def test_a_learner_whose_workers_are_away_waits_for_next_to_nothing(farm: Farm) -> None:
    endpoint, length = free_endpoint(), ("--generations", "40", *SMALL)
    learner = farm.start("learner", "--name", "r", "--listen", endpoint, *length)
    workers = farm.start("worker", "--connect", endpoint, "--workers", "2")
    farm.wait_for(lambda: len(farm.progress("r")) >= 5)
    for pid in [*children(workers.pid), workers.pid]:
        os.kill(pid, 9)
    with connect((endpoint,), 30.0, lambda: False) as link:
        farm.wait_for(lambda: not ask(link, "farm", "r")[0].workers)
    at = len(farm.progress("r"))
    assert at < 40
    cpu, size, start = _cpu(learner.pid), _resident(learner.pid), time.monotonic()
    time.sleep(5.0)
    share = (_cpu(learner.pid) - cpu) / (time.monotonic() - start)
    assert share < 0.05, f"{share:.3f} of a core"
    assert _resident(learner.pid) - size < 2e6
    assert len(farm.progress("r")) == at
    farm.start("worker", "--connect", endpoint, "--workers", "1")
    assert learner.wait(120) == 0
    farm.call("run", "--name", "whole", *length)
    assert farm.summary("r")["parameters_sha256"] == farm.summary("whole")["parameters_sha256"]


def _cpu(pid: int) -> float:
    """Processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _resident(pid: int) -> float:
    """Memory of a process [bytes]."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
