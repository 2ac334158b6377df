"""Forked worker processes: in programs of their own, as pytest has threads."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from farm import processes

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere workers are new processes"
)

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
        [sys.executable, "-c", SCRIPT + body],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def running(pid: str) -> bool:
    """Whether a process has not ended; nobody may have waited for it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("text", "expected"), [("max 100000", 4), ("150000 100000", 2), ("1000 100000", 1), ("", 4)]
)
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
    assert (
        ran("""
with forks(2) as waiting:
    pids = [each.pid for each in waiting]
    assert len(pids) == 2
print([os.path.exists(f"/proc/{pid}") for pid in pids])
""")
        == "[False, False]\n"
    )


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
    assert (
        ran("""
threading.Thread(target=threading.Event().wait, daemon=True).start()
with forks(2) as waiting, LocalWorkers(1, NOBODY, waiting) as pool:
    # empty while the program is loaded
    words = until(lambda: open(f"/proc/{pool.pids[0]}/cmdline", "rb").read())
    print(waiting, b"workers" in words)
""")
        == "[] True\n"
    )


FORKING = """
sys.stdout.flush()
child = os.fork()
if not child:
    print(*(signal.getsignal(each) == default for each, default in (
        (signal.SIGTERM, signal.SIG_DFL),
        (signal.SIGHUP, signal.SIG_DFL),
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGUSR1, signal.SIG_IGN))), flush=True)
    os._exit(0)
status = os.waitpid(child, 0)[1]
sys.exit(status and f"the fork ended with status {status}")
"""


@pytest.mark.parametrize(
    "begin",
    ["default_signals_in_forks()", "import workers.__main__; workers.__main__.main(['-h'])"],
)
def test_what_a_task_forks_ends_at_signals(begin: str) -> None:
    output = ran(
        f"""
from farm.processes import default_signals_in_forks
try:
    {begin}
except SystemExit:
    pass
for each in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
    signal.signal(each, lambda *_: None)
signal.signal(signal.SIGUSR1, signal.SIG_IGN)
"""
        + FORKING
    )
    assert output.splitlines()[-1] == "True True True True"


STARTS_ANOTHER = """
import os, subprocess, sys
child = subprocess.Popen(["sleep", "1000"])
print(os.getpid(), child.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("how", ["pool.kill(pid)", "os.kill(pid, signal.SIGKILL)"])
def test_what_a_killed_worker_has_started_ends_with_it(how: str, tmp_path: Path) -> None:
    (tmp_path / "leader.py").write_text(STARTS_ANOTHER)
    pid, child = ran(f"""
import subprocess
pool = LocalWorkers(0, NOBODY)
leader = subprocess.Popen([sys.executable, {str(tmp_path / "leader.py")!r}], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True, start_new_session=True)
pool._processes.append(leader)
pid, child = map(int, leader.stdout.readline().split())
{how}
until(lambda: leader.poll() is not None)
pool._restarts = 1000
pool.tend()
print(pid, child)
""").split()
    limit = time.monotonic() + 20
    while running(pid) or running(child):
        assert time.monotonic() < limit
        time.sleep(0.01)


def test_a_program_that_has_used_zenoh_forks_no_workers_and_its_forks_use_none() -> None:
    output = ran("""
from farm.errors import RunError
from farm.net.forks import begin_zenoh
begin_zenoh()
with forks(2) as waiting:
    print(waiting, flush=True)
child = os.fork()
if not child:
    try:
        begin_zenoh()
    except RunError as error:
        print(error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
begin_zenoh()
""")
    assert output.startswith("[]\nthis process was forked from one that has used a farm")
