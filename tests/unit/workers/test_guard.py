"""What received code forks ends with its process, and that with its worker, also when the worker is
killed.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="processes end with their parents on Linux only"
)

WORKER = """
import subprocess, sys
words = [sys.executable, "-c", sys.argv[1]]
process = subprocess.Popen(words, start_new_session=True, stdout=subprocess.PIPE, text=True)
print(process.pid, process.stdout.readline(), flush=True)
process.wait()
"""
CODE = """
import subprocess, sys, time
from farm import runner_process
runner_process.bound()
runner_process.guard()
print(subprocess.Popen(["sleep", "600"]).pid, flush=True)
{then}
"""


def alive(group: int) -> bool:
    """Whether a process of a group is there, other than a zombie."""
    for entry in Path("/proc").iterdir():
        try:
            state, _, its_group = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(its_group) == group and state not in "ZX":
            return True
    return False


@pytest.mark.parametrize(
    "then", ["time.sleep(600)", "raise SystemExit", "import os; os.kill(os.getpid(), 9)"]
)
def test_what_received_code_forks_ends_with_it(then: str) -> None:
    worker = subprocess.Popen(
        [sys.executable, "-c", WORKER, CODE.format(then=then)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert worker.stdout
        group = int(worker.stdout.readline().split()[0])
        if then.startswith("time"):
            assert alive(group)
            os.kill(worker.pid, signal.SIGKILL)
        until = time.monotonic() + 20.0
        while alive(group):
            assert time.monotonic() < until, "a process of the group goes on"
            time.sleep(0.02)
    finally:
        worker.kill()
        worker.wait()
        worker.stdout.close()
