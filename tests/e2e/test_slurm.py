"""The job script of docs/deployment under a real Slurm: a cluster of one node, made for the
test.
"""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import SMALL, Farm

from farm.commands import certificates
from farm.net.session import free_endpoint

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parents[2] / "docs/deployment/workers.sbatch"
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scancel", "squeue", "scontrol")

Slurm = Callable[..., str]


@pytest.fixture
def slurm(farm: Farm, monkeypatch: pytest.MonkeyPatch) -> Iterator[Slurm]:
    """Run a command of Slurm in a cluster of one node with two cores; return its output."""
    paths = [shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") for name in PROGRAMS]
    if not all(paths):
        pytest.skip("slurm is not installed (Debian: slurm-wlm, munge)")
    munged, controller, node = map(str, paths[:3])
    # A short path: the socket's is limited to 107 characters.
    with tempfile.TemporaryDirectory(prefix="slurm-") as name:
        folder, host = Path(name), socket.gethostname().partition(".")[0]
        folder.chmod(0o755)
        key, configuration = folder / "key", folder / "slurm.conf"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        user = subprocess.run(
            ["id", "-un"], capture_output=True, text=True, check=True
        ).stdout.strip()
        settings = {
            "ClusterName": "test",
            "SlurmctldHost": f"{host}(127.0.0.1)",
            "SlurmUser": user,
            "SlurmdUser": user,
            "AuthType": "auth/munge",
            "AuthInfo": f"socket={folder}/munge",
            "CredType": "cred/munge",
            "SlurmctldPort": _port(),
            "SlurmdPort": _port(),
            "ProctrackType": "proctrack/linuxproc",
            "TaskPlugin": "task/none",
            "SelectType": "select/cons_tres",
            "SelectTypeParameters": "CR_CPU",
            "StateSaveLocation": f"{folder}/state",
            "SlurmdSpoolDir": f"{folder}/spool",
            "MpiDefault": "none",
            "SlurmctldPidFile": f"{folder}/controller",
            "SlurmdPidFile": f"{folder}/node",
            "MailProg": "/bin/true",
            "SlurmdParameters": "config_overrides",
            "ReturnToService": "2",
        }
        nodes = (
            f"NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000\nPartitionName=p"
            f" Nodes={host} Default=YES\n"
        )
        configuration.write_text(
            "".join(f"{name}={value}\n" for name, value in settings.items()) + nodes
        )
        for each in ("state", "spool"):
            (folder / each).mkdir()
        monkeypatch.setenv("SLURM_CONF", str(configuration))
        files = [
            f"--{name}={folder}/{file}" for name, file in (("key-file", "key"), ("socket", "munge"))
        ]
        files += [f"--{name}={folder}/{name}" for name in ("pid-file", "log-file", "seed-file")]
        daemons = [farm.start_program(munged, "--foreground", "--force", *files)]
        farm.wait_for((folder / "munge").exists)
        daemons += [
            farm.start_program(each, "-D", "-f", str(configuration)) for each in (controller, node)
        ]

        def run(*words: str) -> str:
            done = subprocess.run(
                words, cwd=farm.folder, capture_output=True, text=True, timeout=30, check=False
            )
            return done.stdout + done.stderr

        try:
            farm.wait_for(lambda: "idle" in run("sinfo"))
            yield run
            run("scancel", "--me")
            farm.wait_for(lambda: not run("squeue", "--noheader"))
        finally:
            for daemon in reversed(daemons):
                daemon.terminate()
                daemon.wait(20)


def _port() -> str:
    return free_endpoint().rpartition(":")[2]


def test_tasks_of_the_job_script_join_leave_and_are_replaced(
    farm: Farm, slurm: Slurm, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint, certs = free_endpoint().replace("tcp", "tls"), farm.folder / "certs"
    certificates.main(["new", str(certs), "--learner", "127.0.0.1", "--worker", "slurm"])
    farm.start_router(endpoint, "--tls", str(certs / "learner"))
    monkeypatch.setenv("FARM", str(Path(sys.executable).with_name("farm")))
    monkeypatch.setenv("FARM_ROUTER", endpoint)
    monkeypatch.setenv("FARM_CERTS", str(certs / "worker-slurm"))
    output = slurm("sbatch", "--array=0-49", "--cpus-per-task=2", str(SCRIPT))
    assert "Submitted batch job" in output
    job = output.split()[-1]

    def log(task: int) -> str:
        path = farm.folder / f"farm-workers-{job}-{task}.log"
        return path.read_text() if path.exists() else ""

    farm.wait_for(lambda: log(0).count("joined as") == 2)
    assert not log(1), "the node's cores are used"
    slurm("scancel", f"{job}_0")
    farm.wait_for(lambda: "SIGTERM: leaving" in log(0))
    farm.wait_for(lambda: log(1).count("joined as") == 2)
    farm.call(
        "learner",
        "--connect",
        endpoint,
        "--tls",
        str(certs / "learner"),
        "--name",
        "r",
        *SMALL,
        "--generations",
        "5",
    )
    assert farm.summary("r")["workers"] == 2
    slurm("scancel", job)
    farm.wait_for(lambda: "SIGTERM: leaving" in log(1))
    assert not log(2)
