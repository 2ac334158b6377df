"""A run or a worker ends quickly in every case, prints one line, and leaves no process behind."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import SMALL, Farm, children

from farm.net.session import free_endpoint

pytestmark = pytest.mark.slow

SOON = 10.0
"""Generous, for a machine that has other things to do [s]; 2 is what is wanted."""


def alive(pids: list[int]) -> list[int]:
    return [pid for pid in pids if Path(f"/proc/{pid}/stat").exists() and _state(pid) != "Z"]


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "Z"


def end(
    process: "subprocess.Popen[str]", number: signal.Signals, record: Callable[[str, object], None]
) -> str:
    """Send a signal, and check that the program ends quickly and leaves no process behind."""
    workers = children(process.pid)
    assert workers
    start = time.monotonic()
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    took = time.monotonic() - start
    record("seconds", round(took, 2))
    print(f"ended after {took:.2f} s by {number.name}")  # noqa: T201
    assert took < SOON
    assert alive(workers) == []
    assert "Traceback" not in output
    return output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_with_recording(farm: Farm, number: signal.Signals, record_property) -> None:
    process = farm.start("run", "--name", "r", "--generations", "100000", "--pairs", "6")
    farm.wait_for(lambda: len(farm.progress("r")) >= 12)
    output = end(process, number, record_property)
    assert process.returncode == 130
    assert f"{'Ctrl-C' if number == signal.SIGINT else 'SIGTERM'}: saving and ending" in output
    assert "continue with: farm run --resume runs/r" in output
    assert farm.summary("r")["state"] == "interrupted"
    assert farm.summary("r")["generations"] == len(farm.progress("r"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_worker(farm: Farm, number: signal.Signals, record_property) -> None:
    endpoint = free_endpoint()
    farm.start("learner", "--name", "r", "--generations", "100000", "--listen", endpoint, *SMALL)
    worker = farm.start("worker", "--connect", endpoint, "--workers", "2")
    farm.wait_for(lambda: farm.progress("r"))
    end(worker, number, record_property)
    assert worker.returncode == 0


def test_a_worker_that_finds_no_learner(farm: Farm, record_property) -> None:
    worker = farm.start("worker", "--connect", free_endpoint(), "--workers", "2")
    assert worker.stdout
    while "no answer from" not in worker.stdout.readline():
        pass
    end(worker, signal.SIGINT, record_property)
    assert worker.returncode == 0


def test_a_learner_that_finds_no_router(farm: Farm) -> None:
    learner = farm.start("learner", "--name", "r", "--connect", free_endpoint(), *SMALL)
    assert learner.stdout
    while "no answer from" not in learner.stdout.readline():
        pass
    learner.send_signal(signal.SIGINT)
    output, _ = learner.communicate(timeout=SOON)
    assert learner.returncode == 130
    assert "Traceback" not in output
    assert not (farm.folder / "runs").exists()


def test_a_run_that_diverges(farm: Farm) -> None:
    rate = ("--policy", "direct", "--features", "5", "--learning-rate-mu", "1e308")
    output = farm.call("run", "--name", "r", "--generations", "50", *rate, *SMALL, status=1)
    (line,) = [line for line in output.splitlines() if line.startswith("farm: ")]
    assert line.startswith("farm: the run diverged: the update after generation ")
    assert line.endswith("is not finite; everything before is saved")
    assert "Traceback" not in output
    assert "Warning" not in output
    summary = farm.summary("r")
    assert summary["state"] == "diverged"
    assert summary["generations"] == len(farm.progress("r"))


def test_one_process_a_run(farm: Farm) -> None:
    process = farm.start("run", "--name", "r", "--generations", "100000", *SMALL)
    farm.wait_for(lambda: farm.progress("r"))
    output = farm.call("run", "--resume", "runs/r", "--no-record", status=2)
    assert "another process is working on the run in runs/r" in output
    assert process.poll() is None
    count = len(farm.progress("r"))
    farm.wait_for(lambda: len(farm.progress("r")) > count)


def test_a_folder_whose_name_is_no_name(farm: Farm) -> None:
    farm.call("run", "--name", "r", "--generations", "1", *SMALL)
    (farm.folder / "runs" / "r").rename(farm.folder / "runs" / "r (copy) #1")
    output = farm.call("run", "--resume", "runs/r (copy) #1", "--no-record", status=2)
    assert "run 'r (copy) #1' is not a name" in output
    assert len(output.strip().splitlines()) == 1


def test_workers_that_cannot_work(farm: Farm, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = farm.folder / "broken"
    broken.mkdir()
    (broken / "sitecustomize.py").write_text(
        "import os, sys\n"
        "if 'workers' in sys.orig_argv:\n    os._exit(1)\n"
        "os.register_at_fork(after_in_child=lambda: os._exit(1))\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(broken))
    output = farm.call("run", "--name", "r", "--generations", "1", *SMALL, status=1)
    assert "farm: no local worker keeps running; see their messages above" in output
    assert farm.summary("r")["state"] == "failed"


@pytest.fixture
def small_disk(farm: Farm) -> Iterator[Path]:
    """A file system of 100 kB at `runs`, and a way to make it larger."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root can mount a small file system")
    folder = farm.folder / "runs"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("this container may not mount a small file system")
    yield folder
    farm.close()
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk(farm: Farm, small_disk: Path) -> None:
    output = farm.call("run", "--name", "r", "--generations", "40", *SMALL, status=1)
    (line,) = [line for line in output.splitlines() if line.startswith("farm: ")]
    assert (
        "cannot write to runs/r: No space left on device; the run is saved up to generation "
        in line
    )
    assert line.endswith(": make room and --resume it")
    assert "Traceback" not in output
    assert "Logging error" not in output
    assert not list(small_disk.glob("r/*.new"))
    saved = int(line.partition("up to generation ")[2].partition(":")[0])
    assert 0 < saved < 40

    output = farm.call("run", "--resume", "runs/r", "--no-record", status=1)
    assert "No space left on device" in output
    assert "Traceback" not in output

    subprocess.run(["mount", "-o", "remount,size=10m", str(small_disk)], check=True)
    farm.call("run", "--resume", "runs/r", "--no-record")
    farm.call("run", "--name", "undisturbed", "--generations", "40", *SMALL)
    assert (
        farm.summary("r")["parameters_sha256"] == farm.summary("undisturbed")["parameters_sha256"]
    )
    assert [line["generation"] for line in farm.progress("r")] == list(range(1, 41))
