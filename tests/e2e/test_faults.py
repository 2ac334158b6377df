"""If anything dies, hangs, slows down or is cut off, every pair counts once, and the numbers stay
the same.

Each test ends with the hash of the undisturbed run, and says how long the run stood still at most;
`pytest --measurements FILE` writes that down (docs/results/reliability.md holds ours).
"""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from network import BadLink, Network, address
from processes import Farm, children

from farm.net.session import free_endpoint

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]

GENERATIONS = 60
SETTINGS = ("--name", "r", "--pairs", "6", "--generations", str(GENERATIONS), "--no-record")
Check = Callable[..., None]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    farm = Farm(tmp_path_factory.mktemp("undisturbed"))
    farm.call("run", *SETTINGS)
    return str(farm.summary("r")["parameters_sha256"])


@pytest.fixture
def check(farm: Farm, undisturbed: str, request: pytest.FixtureRequest) -> Check:
    """Check that every pair counts once, the hash is the same, no pause is too long [s], and the
    fault occurred.

    Those are a least standstill [s], jobs given out again, or a word in the run's log.
    """

    def done(
        what: str,
        allowed: float,
        away: float = 0.0,
        *,
        least: float = 0.0,
        reissued: int = 0,
        log: str = "",
    ) -> None:
        lines = farm.progress("r")
        assert [line["generation"] for line in lines] == list(range(1, GENERATIONS + 1))
        assert [line["rollouts"] for line in lines] == [12 * g for g in range(1, GENERATIONS + 1)]
        assert farm.summary("r")["parameters_sha256"] == undisturbed
        times = [line["seconds"] for line in lines]
        still = max(away, *(b - a for a, b in zip(times, times[1:], strict=False)))
        path = request.config.getoption("--measurements")
        if path:
            with Path(path).open("a") as file:
                file.write(f"| {what} | {lines[-1]['reissued']} | {still:.1f} | {allowed:g} |\n")
        assert least <= still <= allowed
        assert lines[-1]["reissued"] >= reissued
        assert log in (farm.folder / "runs/r/log.txt").read_text()

    return done


def finish(process: "subprocess.Popen[str]") -> None:
    output, _ = process.communicate(timeout=150)
    assert process.returncode == 0, output


def resume(farm: Farm, *flags: str) -> float:
    """Start a killed learner again and see it finish; how long until its first generation [s]."""
    done, before = len(farm.progress("r")), time.monotonic()
    assert done < GENERATIONS
    learner = farm.start("learner", "--resume", "runs/r", "--no-record", *flags)
    farm.wait_for(lambda: len(farm.progress("r")) > done)
    away = time.monotonic() - before
    finish(learner)
    return away


def running(farm: Farm, generation: int = 10) -> None:
    farm.wait_for(lambda: len(farm.progress("r")) >= generation)


def start(
    farm: Farm, *worker_flags: str, processes: int = 2
) -> tuple["subprocess.Popen[str]", "subprocess.Popen[str]"]:
    """A learner, and the command that holds its workers."""
    endpoint = free_endpoint()
    learner = farm.start("learner", "--listen", endpoint, *SETTINGS)
    workers = farm.start(
        "worker", "--connect", endpoint, "--workers", str(processes), *worker_flags
    )
    return learner, workers


def test_a_worker_killed(farm: Farm, check: Check) -> None:
    learner, workers = start(farm)
    running(farm)
    os.kill(children(workers.pid)[0], signal.SIGKILL)
    finish(learner)
    check("worker killed", 5, log=" left")


def test_a_worker_frozen_and_thawed(farm: Farm, check: Check) -> None:
    learner, workers = start(farm)
    running(farm)
    frozen = children(workers.pid)[0]
    os.kill(frozen, signal.SIGSTOP)
    farm.wait_for(lambda: len(farm.progress("r")) >= 40)
    os.kill(frozen, signal.SIGCONT)
    finish(learner)
    check("worker stopped (SIGSTOP), later continued", 10, least=0.9, reissued=1)


def test_a_worker_slow_by_a_hundred_times(farm: Farm, check: Check) -> None:
    learner, workers = start(farm)
    running(farm)
    slow, over = children(workers.pid)[0], threading.Event()

    def hinder() -> None:
        while not over.is_set():
            os.kill(slow, signal.SIGSTOP)
            over.wait(0.198)
            os.kill(slow, signal.SIGCONT)
            over.wait(0.002)

    thread = threading.Thread(target=hinder)
    thread.start()
    try:
        finish(learner)
    finally:
        over.set()
        thread.join()
        os.kill(slow, signal.SIGCONT)
    check("worker slow by 100 times", 15, least=0.9, reissued=1)


def test_a_learner_killed_and_back_at_another_address(farm: Farm, check: Check) -> None:
    first, second = free_endpoint(), free_endpoint()
    learner = farm.start("learner", "--listen", first, *SETTINGS)
    farm.start("worker", "--connect", first, "--connect", second, "--workers", "2")
    running(farm)
    learner.kill()
    learner.communicate(timeout=10)
    assert learner.returncode == -signal.SIGKILL
    away = resume(farm, "--listen", second)
    check("learner killed, back at a second --connect", 15, away)


def test_a_learner_behind_a_router_killed_and_back(farm: Farm, check: Check) -> None:
    endpoint = free_endpoint()
    farm.start("router", "--listen", endpoint)
    learner = farm.start("learner", "--connect", endpoint, *SETTINGS)
    farm.start("worker", "--connect", endpoint, "--workers", "2")
    running(farm)
    learner.kill()
    learner.communicate(timeout=10)
    assert learner.returncode == -signal.SIGKILL
    away = resume(farm, "--connect", endpoint)
    check("learner behind a router killed and back", 15, away)


def test_a_router_killed_and_back(farm: Farm, check: Check) -> None:
    endpoint = free_endpoint()
    router = farm.start("router", "--listen", endpoint)
    learner = farm.start("learner", "--connect", endpoint, *SETTINGS)
    farm.start("worker", "--connect", endpoint, "--workers", "2")
    running(farm)
    router.kill()
    router.communicate(timeout=10)
    farm.start("router", "--listen", endpoint)
    finish(learner)
    check("router killed and back", 15, log=" left")


@pytest.mark.parametrize("which", [0, 1], ids=["listening", "connecting"])
def test_a_router_of_two_sites_killed_and_back(farm: Farm, check: Check, which: int) -> None:
    here, remote = free_endpoint(), free_endpoint()
    flags = [(here,), (remote, "--connect", here)]
    routers = [farm.start_router(*words) for words in flags]
    learner = farm.start("learner", "--connect", here, *SETTINGS)
    farm.start("worker", "--connect", remote, "--workers", "2")
    running(farm)
    routers[which].kill()
    routers[which].communicate(timeout=10)
    farm.start_router(*flags[which])
    finish(learner)
    check(
        f"of two joined routers, the {('listening', 'connecting')[which]} one killed and back",
        15,
        log=" left",
    )


def test_two_workers_of_one_name(farm: Farm, check: Check) -> None:
    endpoint = free_endpoint()
    learner = farm.start("learner", "--listen", endpoint, *SETTINGS)
    for _ in range(2):
        farm.start("worker", "--connect", endpoint, "--workers", "1", "--name", "same")
    running(farm)
    finish(learner)
    assert farm.progress("r")[-1]["workers"] == 2
    check("two workers of one name", 5)


def test_clocks_that_jump(farm: Farm, check: Check) -> None:
    library = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
    if not library.exists():
        pytest.skip("libfaketime is not installed (Debian: faketime)")
    clock = farm.folder / "clock"
    clock.write_text("+0\n")
    os.environ |= {
        "LD_PRELOAD": str(library),
        "FAKETIME_TIMESTAMP_FILE": str(clock),
        "FAKETIME_NO_CACHE": "1",
    }
    os.environ["FAKETIME_DONT_FAKE_MONOTONIC"] = "1"
    try:
        clock.write_text("+3600\n")
        output = farm.start_python("-c", "import time; print(time.time())").communicate(timeout=30)[
            0
        ]
        assert float(output) - time.time() > 3000, "the clock does not jump"
        clock.write_text("+0\n")
        learner, _ = start(farm)
    finally:
        for name in (
            "LD_PRELOAD",
            "FAKETIME_TIMESTAMP_FILE",
            "FAKETIME_NO_CACHE",
            "FAKETIME_DONT_FAKE_MONOTONIC",
        ):
            del os.environ[name]
    for generation, jump in ((5, "+3600\n"), (20, "-86400\n"), (35, "+0\n")):
        running(farm, generation)
        clock.write_text(jump)
    finish(learner)
    check("clocks jump by an hour and a day", 5)


def apart(farm: Farm, hosts: list[str]) -> "subprocess.Popen[str]":
    """A learner on one host, two workers on the other."""
    endpoint = f"tcp/{address(0)}:7447"
    learner = farm.start(
        "learner", "--listen", endpoint, "--trust-network", *SETTINGS, host=hosts[0]
    )
    farm.start("worker", "--connect", endpoint, "--workers", "2", host=hosts[1])
    running(farm)
    return learner


@pytest.mark.parametrize("seconds", [3, 15])
def test_a_link_that_is_cut(farm: Farm, check: Check, seconds: int) -> None:
    with closing(Network(2)) as network:
        learner = apart(farm, network.hosts)
        network.cut(1)
        threading.Event().wait(seconds)  # the fault itself lasts so long
        network.heal(1)
        finish(learner)
    check(f"link cut for {seconds} s", seconds + 15, least=0.8 * seconds)


def test_a_link_that_loses_and_delays(farm: Farm, check: Check) -> None:
    with closing(BadLink(delay=(0.02, 0.06), loss=0.05)) as link:
        finish(apart(farm, link.hosts))
        assert link.lost > 0.02 * link.carried > 20, "the link was not bad"
    check("5 % of packets lost, all 20 to 60 ms late", 15)
