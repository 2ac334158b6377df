"""Forked worker processes: in programs of their own, as pytest has threads."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from farm import processes

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere workers are new processes")

SCRIPT = """
import os, signal, sys, threading, time
from farm.net.session import free_endpoint
from farm.processes import LocalWorkers, forks

NOBODY = ["--connect", free_endpoint()]  # the workers wait for a learner

def until(what):
    limit = time.monotonic() + 20
    while not (found := what()):
        assert time.monotonic() < limit
        time.sleep(0.01)
    return found
"""


def ran(body: str) -> str:
    """What a program prints."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT + body], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def running(pid: str) -> bool:
    """Whether a process has not ended; nobody may have waited for it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(("text", "expected"), [("max 100000", 4), ("150000 100000", 2), ("1000 100000", 1), ("", 4)])
def test_cores_are_not_more_than_a_container_s_share(
    text: str, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpu.max").write_text(text)
    monkeypatch.setattr(processes, "_QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    assert processes.cores() == expected


def test_a_killed_fork_is_replaced_by_another_one() -> None:
    output = ran("""
with forks(2) as waiting, LocalWorkers(2, NOBODY, waiting) as pool:
    before = pool.pids
    assert before == [each.pid for each in waiting]
    os.kill(before[0], signal.SIGKILL)
    until(lambda: pool.pids == before[1:])
    assert pool.tend() == []
    after = pool.pids
    assert after[1:] == before[1:] and after[0] not in before
    print(open(f"/proc/{after[0]}/cmdline").read() == open("/proc/self/cmdline").read())
print([os.path.exists(f"/proc/{pid}") for pid in {*before, *after}])
""")
    assert output == "True\n[False, False, False]\n"


def test_forks_that_never_work_end() -> None:
    assert ran("""
with forks(2) as waiting:
    pids = [each.pid for each in waiting]
    assert len(pids) == 2
print([os.path.exists(f"/proc/{pid}") for pid in pids])
""") == "[False, False]\n"  # fmt: skip


def test_they_end_with_their_parent_however_it_ends() -> None:
    pids = ran("""
with forks(3) as waiting:
    pool = LocalWorkers(2, NOBODY, waiting)  # the third one still waits
    print(*(each.pid for each in waiting), flush=True)
    os._exit(0)
""").split()
    assert len(pids) == 3
    limit = time.monotonic() + 20
    while any(map(running, pids)):
        assert time.monotonic() < limit
        time.sleep(0.01)


def test_a_process_with_threads_does_not_fork() -> None:
    assert ran("""
threading.Thread(target=threading.Event().wait, daemon=True).start()
with forks(2) as waiting, LocalWorkers(1, NOBODY, waiting) as pool:
    words = until(lambda: open(f"/proc/{pool.pids[0]}/cmdline", "rb").read())  # empty while the program is loaded
    print(waiting, b"workers" in words)
""") == "[] True\n"  # fmt: skip
