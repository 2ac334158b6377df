"""The live stream: viewers that watch, stop reading, are killed or come late do not affect the
run.
"""

import signal
import subprocess
from pathlib import Path

import pytest
import rerun_cli
from processes import Farm
from recordings import generations

from farm.net.session import free_endpoint

pytestmark = pytest.mark.slow

COUNT = 150
RERUN = str(Path(rerun_cli.__file__).with_name("rerun"))


def connections(port: int, state: str = "01") -> int:
    """How many are connected to a port of this machine; in state 0A: how many listen there."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return sum(int(line[1].partition(":")[2], 16) == port and line[3] == state for line in lines)


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


@pytest.fixture
def viewers(farm: Farm, monkeypatch: pytest.MonkeyPatch) -> "Viewers":
    monkeypatch.setenv("HOME", str(farm.folder))  # where the viewer keeps its settings
    return Viewers(farm)


class Viewers:
    """Rerun's own program at a learner's stream, without a window."""

    def __init__(self, farm: Farm) -> None:
        self.farm, self.port = farm, free_port()

    def look(self) -> "subprocess.Popen[str]":
        """A viewer that is connected; the test is skipped where it cannot draw."""
        return self._connected("--headless", "--bind", "127.0.0.1", "--port", str(free_port()))

    def keep(self, path: Path) -> "subprocess.Popen[str]":
        """One that writes into a file what a viewer would show."""
        return self._connected("--save", str(path))

    def _connected(self, *flags: str) -> "subprocess.Popen[str]":
        before = connections(self.port)
        viewer = self.farm.start_program(RERUN, f"rerun+http://127.0.0.1:{self.port}/proxy", *flags)
        self.farm.wait_for(lambda: connections(self.port) > before or viewer.poll() is not None)
        if viewer.poll() is not None:
            assert viewer.stdout
            pytest.skip(f"Rerun's viewer does not start here: {viewer.stdout.read()[-500:]}")
        return viewer


@pytest.mark.slow
def test_whatever_viewers_do(farm: Farm, viewers: Viewers) -> None:
    endpoint, late = free_endpoint(), farm.folder / "late.rrd"
    flags = ("--pairs", "6", "--generations", str(COUNT))
    learner = farm.start(
        "learner",
        "--name",
        "r",
        "--listen",
        endpoint,
        "--serve",
        f"127.0.0.1:{viewers.port}",
        *flags,
    )
    farm.wait_for(lambda: connections(viewers.port, "0A"))
    looking, killed = viewers.look(), viewers.look()
    farm.start("worker", "--connect", endpoint, "--workers", "1")

    def learnt(count: int) -> None:
        farm.wait_for(lambda: len(farm.progress("r")) >= count)

    learnt(20)
    killed.kill()
    learnt(40)
    # For good, if the run waited for it: the next generations would never come
    looking.send_signal(signal.SIGSTOP)
    saving = viewers.keep(late)
    learnt(100)
    looking.send_signal(signal.SIGCONT)
    output, _ = learner.communicate(timeout=120)
    assert learner.returncode == 0, output
    assert "Traceback" not in output
    saving.wait(30)

    assert (
        generations(farm.folder / "runs/r/run.rrd")
        == generations(late)
        == list(range(1, COUNT + 1))
    )
    farm.call("run", "--name", "undisturbed", "--no-record", *flags)
    assert (
        farm.summary("r")["parameters_sha256"] == farm.summary("undisturbed")["parameters_sha256"]
    )
