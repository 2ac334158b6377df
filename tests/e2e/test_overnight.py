"""Everything together: separate hosts, certificates, workers that keep dying.

The gait is learnt.
"""

import os
import signal
import threading
from contextlib import closing
from pathlib import Path

import pytest
from network import Network, address
from processes import Farm, children

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

RUN = ("--name", "r", "--generations", "600", "--seed", "5", "--no-record")
EVERY = 5.0
"""Between two deaths [s]."""


def test_a_farm_over_three_hosts_learns_the_gait_while_workers_die(
    farm: Farm, request: pytest.FixtureRequest
) -> None:
    farm.call("run", "--out", "undisturbed", *RUN, timeout=300)
    with closing(Network(3)) as network:
        endpoint = f"tls/{address(0)}:7447"
        names = [word for name in ("left", "right") for word in ("--worker", name)]
        farm.call("certificates", "new", "certs", "--learner", address(0), *names)
        learner = farm.start(
            "learner", "--listen", endpoint, "--tls", "certs/learner", *RUN, host=network.hosts[0]
        )
        pools = [
            farm.start(
                "worker",
                "--connect",
                endpoint,
                "--tls",
                f"certs/worker-{name}",
                "--workers",
                "1",
                host=host,
            )
            for name, host in zip(("left", "right"), network.hosts[1:], strict=True)
        ]
        farm.wait_for(lambda: farm.progress("r"))
        over, killed = threading.Event(), 0

        def kill() -> None:
            nonlocal killed
            while not over.wait(EVERY):
                [worker] = children(pools[killed % 2].pid)
                os.kill(worker, signal.SIGKILL)
                killed += 1

        thread = threading.Thread(target=kill)
        thread.start()
        try:
            output, _ = learner.communicate(timeout=500)
        finally:
            over.set()
            thread.join()
        assert learner.returncode == 0, output
    summary, undisturbed = farm.summary("r"), farm.json("undisturbed/r/summary.json")
    assert summary["mean_policy_success"] is True
    assert summary["robust_success_rate"] >= 0.8
    assert summary["parameters_sha256"] == undisturbed["parameters_sha256"]
    assert killed >= 2, "too few workers were killed"
    path = request.config.getoption("--measurements")
    if path:
        with Path(path).open("a") as file:
            file.write(
                f"| {summary['seconds']:.0f} | {killed} | {summary['reissued']} |"
                f" {undisturbed['seconds']:.0f} |\n"
            )
