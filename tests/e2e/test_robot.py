"""A slow device that speaks the protocol in plain Python, beside workers that simulate."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from processes import Farm

from farm.commands import certificates
from farm.net import keys
from farm.net.session import connect, free_endpoint
from farm.net.tls import find

pytestmark = [pytest.mark.slow, pytest.mark.timeout(60)]


def wait_for(process: "subprocess.Popen[str]", words: str) -> str:
    """Its output up to this text."""
    output = ""
    for line in process.stdout or ():
        output += line
        if words in line:
            return output
    raise AssertionError(output)


EXAMPLES = Path(__file__).parents[2] / "examples"
GENERATIONS = 40
DEVICES = ("--any-rounding", "--patience", "20", "--audit", "0.5")
RUN = ("--task", "rig.py:Rig", "--generations", str(GENERATIONS), "--no-record")


def test_the_example_needs_nothing_of_ours() -> None:
    text = (EXAMPLES / "robot_worker.py").read_text()
    imports = {
        line.split()[1].partition(".")[0]
        for line in text.splitlines()
        if line.startswith(("import", "from"))
    }
    assert imports & {"numpy", "mujoco", "farm", "learner", "workers"} == set()


@pytest.mark.parametrize("words", [("--connect", "foo"), ("--tls", "/nowhere")])
def test_what_it_cannot_begin_with_is_said_without_a_traceback(words: tuple[str, str]) -> None:
    command = [sys.executable, str(EXAMPLES / "robot_worker.py"), *words]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 2
    assert "robot_worker.py: error: it cannot start with these settings: " in process.stderr
    assert "Traceback" not in process.stderr


def test_a_slow_device_and_two_simulating_workers_learn_together(farm: Farm) -> None:
    shutil.copy(EXAMPLES / "rig.py", farm.folder)
    certificates.main(
        [
            "new",
            str(farm.folder / "certs"),
            "--learner",
            "127.0.0.1",
            "--worker",
            "rig",
            "--worker",
            "w",
        ]
    )
    endpoint = free_endpoint().replace("tcp/", "tls/")
    farm.start_router(endpoint, "--tls", "certs/learner")
    join = ("--connect", endpoint, "--tls")
    robot = farm.start_python(
        str(EXAMPLES / "robot_worker.py"), *join, "certs/worker-rig", "--clock", "100"
    )
    farm.start("worker", *join, "certs/worker-w", "--workers", "2", "--allow-file", "rig.py")
    with connect((endpoint,), 20, lambda: False, find(farm.folder / "certs", "learner")) as looking:
        farm.wait_for(lambda: len(looking.tokens(keys.worker_token("farm", "**"), 1.0)) == 3)
    output = farm.call("learner", *RUN, *join, "certs/learner", "--name", "r", *DEVICES, timeout=50)
    lines = farm.progress("r")
    assert [line["rollouts"] for line in lines] == [20 * (i + 1) for i in range(GENERATIONS)], (
        "each pair counts once"
    )
    assert lines[0]["mean_policy_return"] < 0, "50 is upright throughout"
    assert lines[-1]["mean_policy_return"] > 40
    assert "failed at a job: the rig" in output, "what it cannot do"
    assert lines[-1]["reissued"] > 0, "other workers do its jobs"
    assert "is expelled" not in output
    robot.terminate()
    did, _ = robot.communicate(timeout=20)
    assert "job " in did, "how many is a question of how fast the simulating workers are"
    assert "ignored" not in did
    farm.call("run", *RUN, "--name", "simulated")
    hashes = {farm.summary(name)["parameters_sha256"] for name in ("r", "simulated")}
    assert len(hashes) == 2, "what the device measured was learnt from"


def test_without_any_rounding_a_device_is_refused(farm: Farm) -> None:
    shutil.copy(EXAMPLES / "rig.py", farm.folder)
    endpoint = free_endpoint()
    learner = farm.start("learner", *RUN, "--listen", endpoint, "--name", "r")
    farm.start_python(str(EXAMPLES / "robot_worker.py"), "--connect", endpoint)
    wait_for(
        learner,
        "it is a device, whose results cannot be repeated: start the learner with --any-rounding",
    )


def test_a_device_refuses_what_it_does_not_know(farm: Farm) -> None:
    endpoint = free_endpoint()
    learner = farm.start(
        "learner", "--listen", endpoint, "--name", "r", "--any-rounding", "--no-record"
    )
    farm.start_python(str(EXAMPLES / "robot_worker.py"), "--connect", endpoint)
    wait_for(
        learner, "does not serve this run: this rig does rig.py:Rig with --policy linear alone"
    )


def test_the_example_as_it_says(farm: Farm) -> None:
    """Workers that simulate are beside it: its jobs are some that the rig's guard stops, however
    late it joins.
    """
    shutil.copy(EXAMPLES / "rig.py", farm.folder)
    lines = (EXAMPLES / "robot_worker.py").read_text().splitlines()
    run, robot = (
        next(line.split() for line in lines if line.startswith(command))
        for command in ("farm run ", "python robot_worker.py ")
    )
    endpoint = free_endpoint()
    _, command, *flags = [endpoint if word.startswith("tcp/") else word for word in run]
    # Soon the guard would stop none
    still = ("--learning-rate-mu", "1e-9", "--learning-rate-sigma", "1e-9")
    learner = farm.start(
        command, *flags, *still, "--generations", "2000", "--no-record", "--name", "r"
    )
    wait_for(learner, " 1/2000 ")
    farm.start_python(str(EXAMPLES / "robot_worker.py"), robot[2], endpoint, "--clock", "50")
    wait_for(learner, "(release robot_worker)")
    wait_for(learner, "failed at a job: the rig")
    wait_for(learner, "3 workers")
